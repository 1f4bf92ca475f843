r"""Independent solution for tendons that run straight from disc to disc, in NumPy alone: a robot as
Cosserat rods between its discs.

Between two discs nothing acts on the rod. In the frame at the start of a piece, where the moment
$m$ and the force $n$ act,

$$R' = R \hat\kappa, \quad p' = R \upsilon, \quad
\Sigma (\kappa, \upsilon - e_x) = R^T (m - p \times n, \ n).$$

At a disc a tendon of tension T pulls its hole along both chords, at its last disc along one, and
the wrenches at the start of all pieces are those for which forces and moments balance at all discs:
found by Newton's method, with differences of the residual.

The published code of Rao, Peyron, Lilge and Burgner-Kahrs 2021 (its model of rods between discs,
https://github.com/SvenLilge/tdcr-modeling) solves this system but for one term, which `axial`
switches: at discs before a tendon's last one it leaves out the part of the tendon's force along the
axis of the disc. Only its equations are used here.
"""

from typing import NamedTuple

import numpy as np

SUBSTEPS = 40
"""Steps of the Runge-Kutta method of fourth order in a piece."""
SHARES = 0.5, 1.0
"""Shares of the tensions and the force, one after another."""
MOST_ITERATIONS, BALANCED, DIFFERENCE = 40, 1e-10, 1e-6
"""Newton steps, size of the last one, and differences, in $EI / L$ and $EI / L^2$."""


class Robot(NamedTuple):
    """Lengths of the pieces, at whose ends the discs are; stiffness (torsion, bending, bending,
    elongation, shear, shear); holes (tendons, 2), the number of the last disc of each tendon, and
    its tension; force at the tip in the world frame. The arm lies along x."""

    lengths: np.ndarray
    stiffness: np.ndarray
    holes: np.ndarray
    last: np.ndarray
    tension: np.ndarray
    force: np.ndarray

    @property
    def units(self) -> np.ndarray:
        """Units of the moment and the force."""
        length = self.lengths.sum()
        return self.stiffness[1] / length ** np.repeat([1, 2], 3)


class Discs(NamedTuple):
    """Rotations (..., discs, 3, 3) and positions (..., discs, 3) of the base and all discs, and the
    wrenches (..., pieces, 6) at the start and at the end of each piece, in the world frame."""

    rotation: np.ndarray
    position: np.ndarray
    start: np.ndarray
    end: np.ndarray


def solve(robot: Robot, *, axial: bool) -> np.ndarray:
    """Positions (discs, 3) of the base and all discs.

    **Raises:** `RuntimeError` if Newton's method does not converge.
    """
    x = np.zeros(6 * len(robot.lengths))
    for share in SHARES:
        part = robot._replace(tension=share * robot.tension, force=share * robot.force)
        x = _newton(part, x, axial)
    return discs(robot, x).position


def _newton(robot: Robot, x: np.ndarray, axial: bool) -> np.ndarray:
    """Root of the residual, from x; a step that does not lower it is halved."""
    moves = DIFFERENCE * np.eye(len(x))
    for _ in range(MOST_ITERATIONS):
        r = residual(robot, x, axial)
        ahead, behind = residual(robot, x + moves, axial), residual(robot, x - moves, axial)
        step = np.linalg.solve((ahead - behind).T / (2 * DIFFERENCE), r)
        part = 1.0
        while part > 1e-3 and _size(residual(robot, x - part * step, axial)) > _size(r) > BALANCED:
            part /= 2
        x = x - part * step
        if _size(step) < BALANCED:
            return x
    left = _size(residual(robot, x, axial))
    raise RuntimeError(f"no balance after {MOST_ITERATIONS} steps, residual {left:.1e}")


def _size(x: np.ndarray) -> float:
    return float(np.max(np.abs(x)))


def discs(robot: Robot, x: np.ndarray) -> Discs:
    """All discs by the wrenches at the starts of the pieces, in their own frames."""
    wrench = robot.units * x.reshape(*x.shape[:-1], -1, 6)
    turns, moves = _pieces(robot, wrench)
    R = [np.broadcast_to(np.eye(3), turns[..., 0, :, :].shape)]
    p = [np.zeros_like(moves[..., 0, :])]
    for i in range(len(robot.lengths)):
        p.append(p[-1] + _apply(R[-1], moves[..., i, :]))
        R.append(R[-1] @ turns[..., i, :, :])
    rotation, position = np.stack(R, -3), np.stack(p, -2)
    moment, force = (_apply(rotation[..., :-1, :, :], part) for part in np.split(wrench, 2, -1))
    start = np.concatenate([moment, force], -1)
    moment = moment - np.cross(np.diff(position, axis=-2), force)
    return Discs(rotation, position, start, np.concatenate([moment, force], -1))


def _pieces(robot: Robot, wrench: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and positions of the ends of all pieces in the frames at their starts."""
    moment, force = np.split(wrench, 2, -1)
    bend, stretch = np.split(robot.stiffness, 2)

    def rates(R: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        back = R.swapaxes(-1, -2)
        kappa = _apply(back, moment - np.cross(p, force)) / bend
        return R @ _skew(kappa), _apply(R, _apply(back, force) / stretch + [1, 0, 0])

    R, p = np.broadcast_to(np.eye(3), (*moment.shape, 3)), np.zeros_like(moment)
    for _ in range(SUBSTEPS):
        h = (robot.lengths / SUBSTEPS)[:, None]
        slopes = [rates(R, p)]
        for part in (0.5, 0.5, 1.0):
            turn, move = slopes[-1]
            slopes.append(rates(R + part * h[..., None] * turn, p + part * h * move))
        turn, move = ((a + 2 * b + 2 * c + d) / 6 for a, b, c, d in zip(*slopes, strict=True))
        R, p = R + h[..., None] * turn, p + h * move
    return R, p


def residual(robot: Robot, x: np.ndarray, axial: bool) -> np.ndarray:
    """Moments and forces (..., 6 pieces) that are missing at the discs, without units."""
    at = discs(robot, x)
    R, p = at.rotation, at.position
    tip = np.broadcast_to([0, 0, 0, *robot.force], at.start[..., :1, :].shape)
    missing = at.end - np.concatenate([at.start[..., 1:, :], tip], -2)
    for hole, last, tension in zip(robot.holes, robot.last, robot.tension, strict=True):
        arm = _apply(R, np.array([0.0, *hole]))
        chord = np.diff(p + arm, axis=-2)[..., :last, :]
        pull = tension * chord / np.linalg.norm(chord, axis=-1, keepdims=True)
        on = -pull
        on[..., :-1, :] += pull[..., 1:, :]
        if not axial:
            axis = R[..., 1:last, :, 0]
            on[..., :-1, :] -= np.sum(axis * on[..., :-1, :], -1, keepdims=True) * axis
        moment = np.cross(arm[..., 1 : last + 1, :], on)
        missing[..., :last, :] -= np.concatenate([moment, on], -1)
    return (missing / robot.units).reshape(x.shape)


def _apply(R: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.einsum("...ij,...j", R, x)


def _skew(x: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(x, -1, 0)
    none = np.zeros_like(a)
    rows = [[none, -c, b], [c, none, -a], [-b, a, none]]
    return np.stack([np.stack(row, -1) for row in rows], -2)

r"""Independent solution for tendons that run straight from disc to disc, in NumPy alone: a robot as
Cosserat rods between its discs.

Between two discs nothing acts on the rod. In the frame at the start of a piece, where the moment
$m$ and the force $n$ act,

$$R' = R \hat\kappa, \quad p' = R \upsilon, \quad
\Sigma (\kappa, \upsilon - e_x) = R^T (m - p \times n, \ n).$$

At a disc a tendon of tension T pulls its hole along both chords, at its last disc along one. With
friction its tension changes from chord to chord by the factor $e^{\mp \mu \varphi}$ of a pulley,
with the angle $\varphi$ between the chords; along a path a chord keeps the tension that it had
between the least and the most that this allows. The wrenches at the start of all pieces are those
for which forces and moments balance at all discs: found by Newton's method, with differences of the
residual.

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
    its tension; force at the tip in the world frame. The arm lies along x.

    `friction`: coefficient of the holes, positive for pull and negative for release; `before`:
    tensions (tendons, pieces) that the chords had, if the arm follows a path; `weight`: of each
    disc in the world frame."""

    lengths: np.ndarray
    stiffness: np.ndarray
    holes: np.ndarray
    last: np.ndarray
    tension: np.ndarray
    force: np.ndarray
    friction: float = 0.0
    before: np.ndarray | None = None
    weight: np.ndarray = np.zeros(3)

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
    return discs(robot, _balance(robot, axial)).position


def _balance(robot: Robot, axial: bool) -> np.ndarray:
    """The wrenches at the starts of all pieces, without units."""
    x = np.zeros(6 * len(robot.lengths))
    for share in SHARES:
        x = newton(scaled(robot, share), x, axial)
    return x


def scaled(robot: Robot, share: float) -> Robot:
    """The robot with a share of its tensions, weights and the force at its tip."""
    return robot._replace(
        tension=share * robot.tension, force=share * robot.force, weight=share * robot.weight
    )


class Sample(NamedTuple):
    """Positions (discs, 3) of the base and all discs, and tensions and lengths of the chords, both
    (tendons, pieces), 0 beyond the ends of tendons."""

    position: np.ndarray
    tension: np.ndarray
    length: np.ndarray


def follow(robot: Robot, path: np.ndarray) -> list[Sample]:
    """The robot with friction in its holes along a path of tensions, from rest.

    **Raises:** `RuntimeError` as `solve`.
    """
    shape = len(robot.holes), len(robot.lengths)
    x, before, found = np.zeros(6 * shape[1]), np.zeros(shape), []
    for tension in path:
        now = robot._replace(tension=tension, before=before)
        x = newton(now, x, True)
        at = discs(now, x)
        tension, length = np.zeros(shape), np.zeros(shape)
        for i in range(shape[0]):
            chord, pull = _chords(now, i, at)
            length[i, : robot.last[i]] = np.linalg.norm(chord, axis=-1)
            tension[i, : robot.last[i]] = np.linalg.norm(pull, axis=-1)
        before = tension
        found.append(Sample(at.position, tension, length))
    return found


def newton(robot: Robot, x: np.ndarray, axial: bool) -> np.ndarray:
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
    R = at.rotation
    tip = np.broadcast_to([0, 0, 0, *robot.force], at.start[..., :1, :].shape)
    missing = at.end - np.concatenate([at.start[..., 1:, :], tip], -2)
    missing[..., 3:] -= robot.weight
    for i, (hole, last) in enumerate(zip(robot.holes, robot.last, strict=True)):
        arm = _apply(R, np.array([0.0, *hole]))
        on = -(pull := _chords(robot, i, at)[1])
        on[..., :-1, :] += pull[..., 1:, :]
        if not axial:
            axis = R[..., 1:last, :, 0]
            on[..., :-1, :] -= np.sum(axis * on[..., :-1, :], -1, keepdims=True) * axis
        moment = np.cross(arm[..., 1 : last + 1, :], on)
        missing[..., :last, :] -= np.concatenate([moment, on], -1)
    return (missing / robot.units).reshape(x.shape)


def _chords(robot: Robot, i: int, at: Discs) -> tuple[np.ndarray, np.ndarray]:
    """Chords of a tendon (..., chords, 3) and the pull along each."""
    last = robot.last[i]
    holes = at.position + _apply(at.rotation, np.array([0.0, *robot.holes[i]]))
    chord = np.diff(holes, axis=-2)[..., :last, :]
    e = chord / np.linalg.norm(chord, axis=-1, keepdims=True)
    cosine = np.clip(np.sum(e[..., 1:, :] * e[..., :-1, :], axis=-1), -1.0, 1.0)
    sine = np.linalg.norm(np.cross(e[..., 1:, :], e[..., :-1, :]), axis=-1)
    turned = np.cumsum(np.arctan2(sine, cosine), axis=-1)
    turned = np.concatenate([np.zeros((*turned.shape[:-1], 1)), turned], axis=-1)
    tension = robot.tension[i] * np.exp(-robot.friction * turned)
    if robot.before is not None:
        most = robot.tension[i] * np.exp(robot.friction * turned)
        tension = np.clip(robot.before[i, :last], tension, most)
    return chord, tension[..., None] * e


def _apply(R: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.einsum("...ij,...j", R, x)


def _skew(x: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(x, -1, 0)
    none = np.zeros_like(a)
    rows = [[none, -c, b], [c, none, -a], [-b, a, none]]
    return np.stack([np.stack(row, -1) for row in rows], -2)

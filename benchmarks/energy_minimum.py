r"""Independent search for stable equilibria as minima of the energy of the elements of
`load_steps`, in NumPy alone: of an arm whose tip is held, and of one with cables of given length
that run straight between discs.

Newton's method with a damping lowers the energy in every step. Where the tip is held, it minimizes
$\Pi + \lambda \cdot g + \tfrac{k}{2} |g|^2$, with g the deviation of the tip; $\lambda$ follows,
and the plain equations of the constraint finish. Stability is the sign of the tangent for the
motions that are allowed. Each search begins from an arm that is bowed another way.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

try:
    from benchmarks.load_steps import Arm, skew, twists
    from benchmarks.ordinary_scenes import DISCS
except ModuleNotFoundError:  # as a script
    from load_steps import Arm, skew, twists
    from ordinary_scenes import DISCS

BOWS, BOW = 6, 1.0
"""Number of searches, and angle [rad] by which the first ones are bowed at their start."""
SPRING = 300.0
"""Stiffness k of the springs, in $EI / L^3$; those for angles are as stiff in $EI / L$."""
OUTER, INNER, FINISHING = 40, 100, 30
BALANCED = 1e-8
"""Norm of the last step that counts as rounding: of strains by the square root of their energy."""


class Minimum(NamedTuple):
    """Strains, force and moment of the support or tensions of the cables in units of the arm, and
    the least eigenvalue of the scaled tangent, above zero where it is stable."""

    strain: np.ndarray
    force: np.ndarray
    margin: float


class EnergyArm(Arm):
    """An arm under dead forces, whose energy is known."""

    @property
    def scale(self) -> np.ndarray:
        """Square roots of the elastic energy of each strain."""
        return np.sqrt(self.h * self.stiffness).reshape(-1)

    def energy(self, xi: np.ndarray) -> float:
        """Energy of the arm and its dead forces."""
        ends, _ = self.poses(xi)
        elastic = 0.5 * self.h * np.sum(self.stiffness * (xi - self.rest) ** 2)
        there = ends[self.element] @ twists((self.before * self.h)[:, None] * xi[self.element])
        return float(elastic - np.sum(self.force * there[:, :3, 3]))

    def lowered(
        self,
        xi: np.ndarray,
        energy: Callable[[np.ndarray], float],
        system: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    ) -> np.ndarray:
        """Strains near a minimum of an energy with a given gradient and second derivative."""
        damping, value = 1.0, energy(xi)
        for _ in range(INNER):
            r, H = system(xi)
            try:
                factor = np.linalg.cholesky(H + damping * np.diag(self.scale**2))
            except np.linalg.LinAlgError:
                damping = max(4 * damping, 1e-3)
                continue
            step = np.linalg.solve(factor.T, np.linalg.solve(factor, r))
            if np.linalg.norm(self.scale * step) < (1e-6 if damping == 0 else 1e-9):
                break
            there = xi - step.reshape(-1, 6)
            new = energy(there)
            if new <= value + 1e-13 * abs(value):
                xi, value = there, new
                damping = damping / 4 if damping > 1e-3 else 0.0
            else:
                damping = max(4 * damping, 1e-3)
            if damping > 1e12:
                break
        return xi

    def moved(self, place: np.ndarray, before: int, middle: np.ndarray) -> np.ndarray:
        """Derivative of the position of a point by the strains of the elements before it."""
        W, p = middle[:before, :3, :3], middle[:before, :3, 3]
        parts = self.h * np.concatenate([-skew(place - p) @ W, W], 2)
        found = np.zeros((3, 6 * self.count))
        found[:, : 6 * before] = parts.transpose(1, 0, 2).reshape(3, -1)
        return found

    def places(self, xi: np.ndarray) -> np.ndarray:
        """Positions of the ends of all elements."""
        return self.poses(xi)[0][:, :3, 3]

    def bowed(self, i: int) -> np.ndarray:
        """Strains from which a search begins."""
        start, angle = self.rest.copy(), 2.4 * i
        bow = BOW * np.cos(np.pi * self.middle * (1 + i // 3))
        start[:, 1] += bow * np.cos(angle)
        start[:, 2] += bow * np.sin(angle)
        return start

    def search(self) -> Minimum | None:
        """A stable equilibrium; None if no search finds one."""
        for i in range(BOWS):
            found = self.minimum(self.bowed(i))
            if found is not None and found.margin > 0:
                return found
        return None

    def minimum(self, start: np.ndarray) -> Minimum | None:
        """The minimum that a start leads to; None if there is none."""
        raise NotImplementedError

    def finished(self, xi: np.ndarray, force: np.ndarray) -> Minimum | None:
        """The equilibrium near a start, and its stability; None if there is none."""
        raise NotImplementedError


class HeldArm(EnergyArm):
    """An arm whose tip is held at a position and, where it is clamped, an orientation."""

    def __init__(self, structure: Any, numbers: dict[str, Any], elements: int = 24):
        super().__init__(structure, numbers, elements)
        self.end = np.asarray(numbers["end"])
        clamped = structure.held == "clamped"
        self.turned = np.asarray(numbers["end rotation"]) if clamped else None
        rows = 3 if self.turned is None else 6
        self.rows = rows
        # the support is the last load
        self.element = np.append(self.element, elements - 1)
        self.before = np.append(self.before, 1.0)
        self.moment = np.vstack([self.moment, np.zeros(3)])
        self.force = np.vstack([self.force, np.zeros(3)])
        self.follows = np.append(self.follows, False)
        self.beyond = np.hstack([self.beyond, np.ones((elements, 1))])

    def support(self, force: np.ndarray) -> None:
        """Sets the force and the moment of the support."""
        self.force[-1] = force[:3]
        if self.turned is not None:
            self.moment[-1] = force[3:]

    def deviation(self, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Deviation of the tip and its derivative by the strains."""
        ends, middle = self.poses(xi)
        R, r = ends[-1, :3, :3], ends[-1, :3, 3]
        W = middle[:, :3, :3]
        turns = np.concatenate([W, np.zeros_like(W)], 2)
        rows, slopes = [r - self.end], [self.moved(r, self.count, middle)]
        if self.turned is not None:
            spin = R @ self.turned.T
            rows.append(
                0.5
                * np.array(
                    [spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1]]
                )
            )
            by_turn = 0.5 * (np.trace(spin) * np.eye(3) - spin.T)
            slopes.append(by_turn @ (self.h * np.concatenate(list(turns), 1)))
        return np.concatenate(rows), np.concatenate(slopes)

    def minimum(self, start: np.ndarray) -> Minimum | None:
        xi, force, last = start, np.zeros(self.rows), np.inf

        def augmented(xi: np.ndarray) -> float:
            off, _ = self.deviation(xi)
            self.support(np.zeros(self.rows))
            return self.energy(xi) + float((0.5 * SPRING * off - force) @ off)

        def system(xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            off, G = self.deviation(xi)
            self.support(force - SPRING * off)
            r, J = self.system(xi, np.zeros(0), 1.0)
            return r, 0.5 * (J + J.T) + SPRING * G.T @ G

        for _ in range(OUTER):
            xi = self.lowered(xi, augmented, system)
            off, _ = self.deviation(xi)
            force, size = force - SPRING * off, np.linalg.norm(off)
            if size < 1e-6 or size > 0.98 * last:
                break
            last = size
        return self.finished(xi, force)

    def finished(self, xi: np.ndarray, force: np.ndarray) -> Minimum | None:
        none = np.zeros(0)
        for _ in range(FINISHING):
            off, G = self.deviation(xi)
            self.support(force)
            r, J = self.system(xi, none, 1.0)
            matrix = np.block([[J, -G.T], [G, np.zeros((self.rows, self.rows))]])
            scale = np.append(1 / self.scale, np.ones(self.rows))
            scaled = scale[:, None] * matrix * scale
            step = scale * np.linalg.lstsq(scaled, scale * np.append(r, off), rcond=1e-15)[0]
            move = step[: xi.size]
            xi, force = xi - move.reshape(-1, 6), force - step[xi.size :]
            if not np.all(np.isfinite(xi)) or np.linalg.norm(self.scale * move) > 1e3:
                return None
            if np.linalg.norm(self.scale * move) < BALANCED:
                return Minimum(xi, force, self.least(xi, force))
        return None

    def least(self, xi: np.ndarray, force: np.ndarray) -> float:
        """Least eigenvalue of the scaled tangent for the motions that the support allows."""
        _, G = self.deviation(xi)
        self.support(force)
        _, J = self.system(xi, np.zeros(0), 1.0)
        J = 0.5 * (J + J.T) / (self.scale[:, None] * self.scale)
        free = np.linalg.svd(G / self.scale)[2][self.rows :]
        return float(np.linalg.eigvalsh(free @ J @ free.T)[0])


class DiscArm(EnergyArm):
    """An arm with elastic cables of given length that run straight between discs."""

    def __init__(self, structure: Any, numbers: dict[str, Any], elements: int = 24):
        super().__init__(structure, numbers, elements)
        assert elements % (DISCS + 1) == 0
        self.holes = [paths[0][0] for paths in self.paths]
        self.free = np.array(self.rest_length) + self.inputs
        self.paths, self.driven = [], []  # what `system` would lay along the sections
        self.stops = np.arange(DISCS + 2) * (elements // (DISCS + 1))

    def lengths(self, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lengths of the cables and their derivatives by the strains."""
        ends, middle = self.poses(xi)
        lengths, slopes = [], []
        for hole in self.holes:
            points = [ends[stop, :3, :3] @ hole + ends[stop, :3, 3] for stop in self.stops]
            moves = [self.moved(p, int(k), middle) for p, k in zip(points, self.stops, strict=True)]
            chords, turns = np.diff(points, axis=0), np.diff(moves, axis=0)
            each = np.linalg.norm(chords, axis=1)
            lengths.append(np.sum(each))
            slopes.append(np.einsum("ij,ijk->k", chords / each[:, None], turns))
        return np.array(lengths), np.array(slopes)

    def tensions(self, lengths: np.ndarray) -> np.ndarray:
        """Tensions of the cables, zero where they are slack."""
        return np.maximum(lengths / self.free - 1, 0) / np.array(self.compliance)

    def energy(self, xi: np.ndarray) -> float:
        lengths, _ = self.lengths(xi)
        stretched = 0.5 * self.tensions(lengths) * np.maximum(lengths - self.free, 0)
        return super().energy(xi) + float(np.sum(stretched))

    def whole(self, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradient and second derivative of the energy."""
        r, J = self.system(xi, np.zeros(0), 1.0)
        lengths, slopes = self.lengths(xi)
        tensions = self.tensions(lengths)
        stiff = (tensions > 0) / (np.array(self.compliance) * self.free)
        H = 0.5 * (J + J.T) + slopes.T @ (stiff[:, None] * slopes)
        flat, small = xi.reshape(-1), 1e-6
        for j in range(flat.size):
            ahead, back = flat.copy(), flat.copy()
            ahead[j], back[j] = flat[j] + small, flat[j] - small
            ends = [self.lengths(x.reshape(-1, 6))[1] for x in (ahead, back)]
            H[j] += tensions @ (ends[0] - ends[1]) / (2 * small)
        return r + tensions @ slopes, 0.5 * (H + H.T)

    def minimum(self, start: np.ndarray) -> Minimum | None:
        return self.finished(start, np.zeros(0))

    def finished(self, xi: np.ndarray, force: np.ndarray) -> Minimum | None:
        xi = self.lowered(xi, self.energy, self.whole)  # full steps may find and lose a cable
        for _ in range(FINISHING):
            r, H = self.whole(xi)
            scaled = H / (self.scale[:, None] * self.scale)
            move = np.linalg.solve(scaled, r / self.scale)
            xi = xi - (move / self.scale).reshape(-1, 6)
            if not np.linalg.norm(move) < 1e3:
                return None
            if np.linalg.norm(move) < BALANCED:
                force = self.tensions(self.lengths(xi)[0])
                return Minimum(xi, force, float(np.linalg.eigvalsh(scaled)[0]))
        return None

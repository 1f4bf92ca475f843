r"""Independent search for stable equilibria of an arm whose tip is held, in NumPy alone: minima of
the energy of the elements of `load_steps` under the constraint.

The augmented energy $\Pi + \lambda \cdot g + \tfrac{k}{2} |g|^2$, with g the deviation of the tip,
is minimized by Newton's method with a damping under which every step lowers it; $\lambda$ follows.
The plain equations of the constraint finish. Stability is the sign of the tangent for the motions
that the constraint allows. Each search begins from an arm that is bowed another way.
"""

from typing import Any, NamedTuple

import numpy as np

try:
    from benchmarks.load_steps import Arm, skew, twists
except ModuleNotFoundError:  # as a script
    from load_steps import Arm, skew, twists

BOWS, BOW = 6, 1.0
"""Number of searches, and angle [rad] by which the first ones are bowed at their start."""
SPRING = 300.0
"""Stiffness k of the springs, in $EI / L^3$; those for angles are as stiff in $EI / L$."""
OUTER, INNER, FINISHING = 40, 400, 30
BALANCED = 1e-8
"""Norm of the last step that counts as rounding: of strains by the square root of their energy."""


class Minimum(NamedTuple):
    """Strains, force and moment of the support in units of the arm, and the least eigenvalue of the
    scaled tangent, above zero where it is stable."""

    strain: np.ndarray
    force: np.ndarray
    margin: float


class HeldArm(Arm):
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
        self.scale = np.sqrt(self.h * self.stiffness).reshape(-1)

    def support(self, force: np.ndarray) -> None:
        """Sets the force and the moment of the support."""
        self.force[-1] = force[:3]
        if self.turned is not None:
            self.moment[-1] = force[3:]

    def deviation(self, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Deviation of the tip and its derivative by the strains."""
        ends, middle = self.poses(xi)
        R, r = ends[-1, :3, :3], ends[-1, :3, 3]
        W, p = middle[:, :3, :3], middle[:, :3, 3]
        zero = np.zeros((self.count, 3, 3))
        turns = np.concatenate([W, zero], 2)
        moves = np.concatenate([-skew(r - p) @ W, W], 2)
        rows = [r - self.end]
        slopes = [self.h * np.concatenate(list(moves), 1)]
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

    def energy(self, xi: np.ndarray) -> float:
        """Energy of the arm and its dead forces, without the support."""
        ends, _ = self.poses(xi)
        elastic = 0.5 * self.h * np.sum(self.stiffness * (xi - self.rest) ** 2)
        places = self.of_loads(xi, ends)
        return float(elastic - np.sum(self.force[:-1] * places[:-1]))

    def places(self, xi: np.ndarray) -> np.ndarray:
        """Positions of the ends of all elements."""
        return self.poses(xi)[0][:, :3, 3]

    def of_loads(self, xi: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Places of all loads."""
        from_start = twists((self.before * self.h)[:, None] * xi[self.element])
        return (ends[self.element] @ from_start)[:, :3, 3]

    def minimum(self, start: np.ndarray) -> Minimum | None:
        """The minimum that a start leads to; None if there is none."""
        xi, force = start, np.zeros(self.rows)
        none = np.zeros(0)

        def augmented(xi: np.ndarray) -> float:
            off, _ = self.deviation(xi)
            return self.energy(xi) - force @ off + 0.5 * SPRING * off @ off

        last = np.inf
        for _ in range(OUTER):
            damping = 1.0
            value = augmented(xi)
            for _ in range(INNER):
                off, G = self.deviation(xi)
                self.support(force - SPRING * off)
                r, J = self.system(xi, none, 1.0)
                H = 0.5 * (J + J.T) + SPRING * G.T @ G
                try:
                    factor = np.linalg.cholesky(H + damping * np.diag(self.scale**2))
                except np.linalg.LinAlgError:
                    damping = max(4 * damping, 1e-3)
                    continue
                step = np.linalg.solve(factor.T, np.linalg.solve(factor, r))
                size = np.linalg.norm(self.scale * step)
                if damping == 0 and size < 1e-6:
                    break
                there = xi - step.reshape(-1, 6)
                new = augmented(there)
                if new <= value + 1e-13 * abs(value):
                    xi, value = there, new
                    damping = damping / 4 if damping > 1e-3 else 0.0
                else:
                    damping = max(4 * damping, 1e-3)
                if damping > 1e12:
                    break
            off, _ = self.deviation(xi)
            force = force - SPRING * off
            size = np.linalg.norm(off)
            if size < 1e-6 or size > 0.98 * last:
                break
            last = size
        return self.finished(xi, force)

    def finished(self, xi: np.ndarray, force: np.ndarray) -> Minimum | None:
        """The equilibrium near a start, and its stability; None if there is none."""
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

    def search(self, seed: int = 0) -> Minimum | None:
        """A stable equilibrium; None if no search finds one."""
        for i in range(BOWS):
            angle = 2.4 * (seed + i)
            start = self.rest.copy()
            bow = BOW * np.cos(np.pi * self.middle * (1 + i // 3))
            start[:, 1] += bow * np.cos(angle)
            start[:, 2] += bow * np.sin(angle)
            found = self.minimum(start)
            if found is not None and found.margin > 0:
                return found
        return None

"""SciPy in `bench_peers`: the continuous model by `scipy.integrate.solve_bvp`, written by hand.

The state along the arm is the position, the unit quaternion, and the internal force and moment in
the world frame. The strain follows from the balance of each section by Newton's method. The base is
clamped, the force at the tip is given, and the initial guess is straight. If the solve fails, the
tension is increased in five equal steps, each starting from the previous solution.
"""

from typing import Any

import numpy as np
from scipy.integrate import solve_bvp


class Arm:
    """Numbers of an arm of `bench_peers`."""

    def __init__(self, scene: dict[str, Any]):
        area = np.pi * scene["radius"] ** 2
        second = area * scene["radius"] ** 2 / 4
        self.length, self.helix = scene["length"], scene["helix"]
        shear, young = scene["shear"], scene["young"]
        self.stiffness = np.array(
            [
                2 * shear * second,
                young * second,
                young * second,
                young * area,
                shear * area,
                shear * area,
            ]
        )
        self.weight = scene["density"] * area * np.array(scene["gravity"] or (0.0, 0.0, 0.0))
        self.tip_force = np.array(scene["tip_force"] or (0.0, 0.0, 0.0))

    def thread(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position of the thread in the sections, and its slope, shapes (n, 3)."""
        radius, rate = (
            self.helix["radius"],
            1 / (self.helix["radius"] * np.tan(self.helix["angle"])),
        )
        phi = self.helix["phase"] + rate * X
        zero = np.zeros_like(X)
        place = radius * np.stack([zero, np.cos(phi), np.sin(phi)], 1)
        return place, rate * radius * np.stack([zero, -np.sin(phi), np.cos(phi)], 1)

    def strain(self, X: np.ndarray, reaction: np.ndarray, tau: float) -> np.ndarray:
        """Strains (n, 6) that balance the sections."""
        d, slope = self.thread(X)
        P = np.concatenate([-_skew(d), np.broadcast_to(np.eye(3), (len(X), 3, 3))], 2)
        rest = np.array([0, 0, 0, 1.0, 0, 0])
        xi = np.broadcast_to(rest, (len(X), 6)).copy()
        for _ in range(30):
            t = np.einsum("nij,nj->ni", P, xi) + slope
            size = np.linalg.norm(t, axis=1)[:, None]
            t = t / size
            r = self.stiffness * (xi - rest) - tau * np.einsum("nji,nj->ni", P, t) - reaction
            W = (tau / size)[:, :, None] * (np.eye(3) - t[:, :, None] * t[:, None, :])
            step = np.linalg.solve(
                np.diag(self.stiffness) - np.einsum("nji,njk,nkl->nil", P, W, P), r[..., None]
            )[..., 0]
            xi -= step
            if np.max(np.abs(step)) < 1e-12:
                break
        return xi

    def slope(self, X: np.ndarray, y: np.ndarray, tau: float) -> np.ndarray:
        """Derivative of the state."""
        quaternion, force, moment = (
            y[3:7].T / np.linalg.norm(y[3:7], axis=0)[:, None],
            y[7:10].T,
            y[10:].T,
        )
        R = _rotation(quaternion)
        xi = self.strain(
            X,
            np.concatenate(
                [np.einsum("nji,nj->ni", R, moment), np.einsum("nji,nj->ni", R, force)], 1
            ),
            tau,
        )
        tangent = np.einsum("nij,nj->ni", R, xi[:, 3:])
        w, v, k = quaternion[:, :1], quaternion[:, 1:], xi[:, :3]
        turning = 0.5 * np.concatenate(
            [-np.sum(v * k, 1, keepdims=True), w * k + np.cross(v, k)], 1
        )
        weight = np.broadcast_to(-self.weight, tangent.shape)
        return np.concatenate([tangent, turning, weight, -np.cross(tangent, force)], 1).T

    def tip(self, tau: float, tol: float) -> np.ndarray:
        """Position of the tip [m], NaN if `solve_bvp` fails."""
        X = np.linspace(0, self.length, 21)
        start = np.zeros((13, len(X)))
        start[0], start[3] = X, 1.0
        start[7:10] = self.tip_force[:, None]
        solution = self._solved(X, start, tau, tol)
        for share in () if solution.success else np.linspace(0.2, 1, 5):
            solution = self._solved(
                solution.x if share > 0.2 else X,
                solution.y if share > 0.2 else start,
                share * tau,
                tol,
            )
        return solution.y[:3, -1] if solution.success else np.full(3, np.nan)

    def _solved(self, X: np.ndarray, start: np.ndarray, tau: float, tol: float) -> Any:
        base = np.array([0, 0, 0, 1.0, 0, 0, 0])

        def ends(y0: np.ndarray, yL: np.ndarray) -> np.ndarray:
            return np.concatenate([y0[:7] - base, yL[7:10] - self.tip_force, yL[10:]])

        return solve_bvp(
            lambda X, y: self.slope(X, y, tau), ends, X, start, tol=tol, max_nodes=20_000
        )


def _skew(v: np.ndarray) -> np.ndarray:
    zero = np.zeros(len(v))
    x, y, z = v.T
    return np.stack(
        [np.stack([zero, -z, y], 1), np.stack([z, zero, -x], 1), np.stack([-y, x, zero], 1)], 1
    )


def _rotation(q: np.ndarray) -> np.ndarray:
    w, v = q[:, :1, None], q[:, 1:]
    cross = _skew(v)
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross

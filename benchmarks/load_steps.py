r"""Independent search for a stable equilibrium: load steps from zero load with Newton's method on a
dense system, in NumPy alone.

It shares no code with the package, only the numbers of a scene (see `ordinary_scenes`). The arm
consists of N elements of constant strain; lengths are in units of L and forces in units of
$EI / L^2$ of the base. The residual at the middle of each element is

$$r_i = \Sigma (\xi_i - \xi^*) - B \tau_i - Ad(g_i)^T W_i,$$

with $W_i$ the loads beyond, as wrenches about the world origin. A change of strain moves all
elements beyond by the twist $h\,Ad(g_i)\,\delta\xi_i$; the tangent is thus dense and known in
closed form, to second order in h. Each tendon driven by length adds its tension as an unknown and
$\min(T, s) = 0$ as an equation, with s its slack. Friction uses the shares of the last iterate.

Stability refers to an arm whose curvature and twist creep at a rate set by their stiffness, with
all other unknowns in balance; it is determined by the eigenvalues of the scaled tangent. A path
ends where a real eigenvalue becomes zero or negative: there the arm snaps. Complex pairs with a
negative real part mean flutter; only loads without a potential (follower wrenches, dead moments in
space) and friction cause them. A step that turns the arm by more than `MOST_TURN` is halved, so
that the path does not skip to another equilibrium.
"""

from typing import Any, NamedTuple

import numpy as np

ELEMENTS = 48
MOST_TURN = 0.6
"""Largest total turn [rad] of the arm in one load step."""
FIRST_STEP, LEAST_STEP = 0.1, 2e-4
MOST_ITERATIONS = 25, 100
"""Without friction, and with friction, whose shares converge more slowly."""
BALANCED = 1e-7
"""Energy norm of a Newton step that counts as rounding, in $\\sqrt{EI / L}$."""


class Margin(NamedTuple):
    """Least real eigenvalue of the scaled tangent, and least real part of all eigenvalues; both are
    1 at rest."""

    real: float
    all: float


class Path(NamedTuple):
    """End of a path: the share of loads and inputs reached, the stability margin there, the least
    real margin on the path, and the strains and cable tensions."""

    share: float
    margin: Margin
    least: float
    strain: np.ndarray
    tension: np.ndarray

    @property
    def arrived(self) -> bool:
        """Whether the path reaches the full load without a snap."""
        return self.share == 1 and self.least > 0


class Arm:
    """A draw in dimensionless numbers, on N elements."""

    def __init__(self, structure: Any, numbers: dict[str, Any], elements: int = ELEMENTS):
        n = {name: np.asarray(value) for name, value in numbers.items()}
        self.count, self.h, self.rubber = elements, 1 / elements, structure.rubber
        self.middle = (np.arange(elements) + 0.5) * self.h
        L, base = n["length"], n["radius"]
        bending = n["young"] * np.pi * base**4 / 4
        radius = base + (n["tip_radius"] - base) * self.middle
        area, second = np.pi * radius**2, np.pi * radius**4 / 4
        young, shear = n["young"] / bending, n["young"] / (2 + 2 * n["poisson"]) / bending
        angular = [2 * shear * second, young * second, young * second]
        linear = [young * area * L**2, shear * area * L**2, shear * area * L**2]
        self.stiffness = np.stack([*angular, *linear], 1)
        self.rest = np.zeros((elements, 6))
        self.rest[:, 1:3], self.rest[:, 3] = n["curvature"] * L, 1.0
        self._threads(structure, n, L, bending)
        self._wrenches(structure, n, L, bending, area)

    def _threads(self, structure: Any, n: dict[str, Any], L: Any, bending: Any) -> None:
        """Sets up the tendons: positions in the sections, share of each element that they cover,
        inputs, friction, elasticity."""
        tendons, X = structure.tendons, self.middle
        self.paths = []
        for i in range(len(tendons)):
            turn, place = 2 * np.pi * n["turns"][i], n["place"][i] / L
            phi, zero = n["phase"][i] + turn * X, 0 * X
            d = place * np.stack([zero, np.cos(phi), np.sin(phi)], 1)
            self.paths.append((d, turn * place * np.stack([zero, -np.sin(phi), np.cos(phi)], 1)))
        ends = [n["end"][i] / L if laid.ends else 1.0 for i, laid in enumerate(tendons)]
        self.reach = [np.clip(end * self.count - np.arange(self.count), 0, 1) for end in ends]
        self.driven = [i for i, laid in enumerate(tendons) if laid.control == "length"]
        force = bending / L**2
        units = {"length": L, "tension": force, "pressure": -force / n.get("area", 1.0)}
        unit = [units[laid.control] for laid in tendons]
        self.inputs = n["inputs"] / np.array(unit) if tendons else np.zeros(0)
        signs = {"pull": 1.0, "release": -1.0, None: 0.0}
        self.friction = [
            signs[laid.motion] * n["friction"][i] if laid.motion else 0.0
            for i, laid in enumerate(tendons)
        ]
        self.compliance = [
            force / n["stiffness"][i] if laid.elastic else 0.0 for i, laid in enumerate(tendons)
        ]
        self.rest_length = [
            np.sum(self.h * self.reach[i] * self._tangent(self.rest, i)[1])
            for i in range(len(tendons))
        ]

    def _wrenches(
        self, structure: Any, n: dict[str, Any], L: Any, bending: Any, area: np.ndarray
    ) -> None:
        """Sets up the loads, each as (element, share of the element before the load, moment, force,
        whether it is a follower load)."""
        self.loads = []
        unit = bending / L**2
        if structure.gravity:
            weight = self.h * L * 1000.0 * area[:, None] * n["gravity"] / unit
            self.loads += [(i, 0.5, np.zeros(3), weight[i], False) for i in range(self.count)]
        for name in structure.wrenches:
            kind, frame = name.split()
            force, moment = n[f"{name} force"] / unit, n[f"{name} moment"] / (unit * L)
            if kind == "spread":
                part = self.h * L
                self.loads += [
                    (i, 0.5, part * moment, part * force, frame == "body")
                    for i in range(self.count)
                ]
                continue
            place = self.count * (1.0 if kind == "tip" else float(n["point"] / L))
            element = min(int(place), self.count - 1)
            self.loads.append((element, place - element, moment, force, frame == "body"))
        self.element = np.array([load[0] for load in self.loads], int)
        self.before = np.array([load[1] for load in self.loads])
        self.moment = np.array([load[2] for load in self.loads]).reshape(-1, 3)
        self.force = np.array([load[3] for load in self.loads]).reshape(-1, 3)
        self.follows = np.array([load[4] for load in self.loads], bool)
        gap = self.element[None] - np.arange(self.count)[:, None]
        self.beyond = np.where(gap > 0, 1.0, np.where(gap == 0, self.before[None], 0.0))
        """Share of each element (row) that lies before each load (column)."""

    def _tangent(self, xi: np.ndarray, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Unit tangent of a thread in the body frames, and the length of its path per length of the
        arm."""
        d, slope = self.paths[i]
        t = np.cross(xi[:, :3], d) + xi[:, 3:] + slope
        size = np.linalg.norm(t, axis=1)
        return t / size[:, None], size

    def poses(self, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses at the start of each element and at the tip (N + 1), and at the middle of each (N),
        shape (., 4, 4)."""
        whole, half = twists(self.h * xi), twists(0.5 * self.h * xi)
        ends = np.empty((self.count + 1, 4, 4))
        ends[0] = np.eye(4)
        for i, step in enumerate(whole):
            ends[i + 1] = ends[i] @ step
        return ends, ends[:-1] @ half

    def system(
        self, xi: np.ndarray, tension: np.ndarray, s: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Residual, shape (6 N + cables,), and its derivative."""
        N, h = self.count, self.h
        ends, middle = self.poses(xi)
        A = _adjoint(middle)
        W, P, C, diagonal = self._carried(xi, ends, s)
        elastic, H = self._elastic(xi - self.rest)
        r = elastic - np.einsum("nji,nj->ni", A, W)
        left, right = np.swapaxes(A, 1, 2), A
        below, above = (x.transpose(1, 0, 2).reshape(6, -1) for x in (right, -h * C @ right))
        J = np.where(
            _lower(N), (-h * left @ (P + C)).reshape(-1, 6) @ below, left.reshape(-1, 6) @ above
        )
        H -= h * left @ (0.5 * P + diagonal) @ right
        rows, columns = [], []
        for i, (d, _) in enumerate(self.paths):
            T = tension[self.driven.index(i)] if i in self.driven else s * self.inputs[i]
            t, size = self._tangent(xi, i)
            share = self._share(t, middle, i)
            B = np.concatenate([np.cross(d, t), t], 1)
            r += T * share[:, None] * B
            across = (np.eye(3) - t[:, :, None] * t[:, None]) / size[:, None, None]
            lever = np.concatenate([-skew(d), np.broadcast_to(np.eye(3), (N, 3, 3))], 2)
            H += (T * share)[:, None, None] * np.swapaxes(lever, 1, 2) @ across @ lever
            if i in self.driven:
                columns.append((h * share[:, None] * B).reshape(-1))
                rows.append(self._cable(i, T, s, share, size, B))
        for k in range(N):
            J[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = H[k]
        r, J = h * r.reshape(-1), h * J
        if rows:
            slack, by_strain, by_tension = (np.array(x) for x in zip(*rows, strict=True))
            return np.append(r, slack), np.block(
                [[J, np.array(columns).T], [by_strain, np.diag(by_tension)]]
            )
        return r, J

    def _elastic(self, strain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Wrench by the strain of each element and its derivative: linear, or of neo-Hookean
        rubber, whose stiffness in twist and in bending is $c$ and $b$ times that at rest."""
        S, H = self.stiffness, np.zeros((self.count, 6, 6))
        if not self.rubber:
            H[:, range(6), range(6)] = S
            return S * strain, H
        x = 1 + strain[:, 3]
        c, dc, ddc = 1 / x, -1 / x**2, 2 / x**3
        b, db, ddb = (x**-1 + 2 * x**-4) / 3, -(x**-2 + 8 * x**-5) / 3, (x**-3 + 20 * x**-6) / 1.5
        one, zero = np.ones_like(x), np.zeros_like(x)
        share = np.stack([c, b, b, one, one, one], 1)
        by = np.stack([dc, db, db, zero, zero, zero], 1)
        twice = np.stack([ddc, ddb, ddb, zero, zero, zero], 1)
        wrench, energy = share * S * strain, 0.5 * S * strain**2
        wrench[:, 3] = S[:, 3] * (x - x**-2) / 3 + np.sum(by * energy, 1)
        H[:, range(6), range(6)] = share * S
        H[:, 3, :] = H[:, :, 3] = by * S * strain
        H[:, 3, 3] = S[:, 3] * (1 + 2 * x**-3) / 3 + np.sum(twice * energy, 1)
        return wrench, H

    def _cable(
        self, i: int, T: float, s: float, share: np.ndarray, size: np.ndarray, B: np.ndarray
    ) -> tuple:
        """Equation of a cable, and its derivatives with respect to the strain and to its
        tension."""
        reach, given = self.reach[i], self.rest_length[i] + s * self.inputs[i]
        mean = np.sum(share) / np.sum(reach)
        slack = given * (1 + T * mean * self.compliance[i]) - np.sum(self.h * reach * size)
        scale = self.stiffness[0, 3]
        if scale * slack >= T:
            return T, np.zeros(6 * self.count), 1.0
        by_strain = -(self.h * reach[:, None] * B).reshape(-1)
        return scale * slack, scale * by_strain, scale * given * mean * self.compliance[i]

    def _share(self, t: np.ndarray, middle: np.ndarray, i: int) -> np.ndarray:
        """Share of a tendon's force at the middle of each element, by the capstan equation."""
        if not self.friction[i]:
            return self.reach[i]
        t = np.einsum("nij,nj->ni", middle[:, :3, :3], t)
        angle = np.arctan2(
            np.linalg.norm(np.cross(t[:-1], t[1:]), axis=1), np.sum(t[:-1] * t[1:], 1)
        )
        first = 0.5 * angle[:1]  # from the base to the middle of the first element
        return self.reach[i] * np.exp(-self.friction[i] * np.cumsum(np.concatenate([first, angle])))

    def _carried(self, xi: np.ndarray, ends: np.ndarray, s: float) -> tuple[np.ndarray, ...]:
        """Wrench about the origin of the loads beyond the middle of each element, its change by the
        twist of its frame, and its derivatives with respect to twists."""
        N = self.count
        if not len(self.element):
            return np.zeros((N, 6)), *(np.zeros((N, 6, 6)) for _ in range(3))
        g = ends[self.element] @ twists((self.before * self.h)[:, None] * xi[self.element])
        R, r = g[:, :3, :3], g[:, :3, 3]
        follow = self.follows[:, None]
        f = s * np.where(follow, np.einsum("nij,nj->ni", R, self.force), self.force)
        m = s * np.where(follow, np.einsum("nij,nj->ni", R, self.moment), self.moment)
        w = np.concatenate([m + np.cross(r, f), f], 1)
        D = np.where(self.follows[:, None, None], -_turned(w), 0.0)
        F, zero = skew(f), np.zeros((len(w), 3, 3))
        dead = np.concatenate(
            [np.concatenate([F @ skew(r), -F], 2), np.concatenate([zero, zero], 2)], 1
        )
        D = np.where(self.follows[:, None, None], D, dead)
        W = self.beyond @ w
        C, diagonal = (np.tensordot(b, D, 1) for b in (self.beyond, self.beyond**2))
        return W, _turned(W), C, diagonal

    def margin(self, J: np.ndarray) -> Margin:
        """Stability margin from the tangent with respect to curvature and twist, with all other
        unknowns in balance."""
        bent = np.arange(6 * self.count).reshape(-1, 6)[:, :3].reshape(-1)
        others = np.setdiff1d(np.arange(len(J)), bent)
        K = J[np.ix_(bent, bent)] - J[np.ix_(bent, others)] @ np.linalg.solve(
            J[np.ix_(others, others)], J[np.ix_(others, bent)]
        )
        root = np.sqrt(self.h * self.stiffness[:, :3].reshape(-1))
        K = K / (root[:, None] * root)
        least = np.linalg.eigvalsh(0.5 * (K + K.T))[0]
        if least > 0:  # then all eigenvalues have positive real parts
            return Margin(float(least), float(least))
        values = np.linalg.eigvals(K)
        return Margin(
            float(np.min(values.real[values.imag == 0], initial=1.0)), float(np.min(values.real))
        )

    def balance(
        self, xi: np.ndarray, tension: np.ndarray, s: float
    ) -> tuple[np.ndarray, np.ndarray, Margin] | None:
        """Strains, tensions and stability margin of the equilibrium near a start; None if Newton's
        method does not converge."""
        size = 6 * self.count
        weight = np.sqrt(self.h * self.stiffness)
        for _ in range(MOST_ITERATIONS[any(self.friction)]):
            r, J = self.system(xi, tension, s)
            if not np.all(np.isfinite(r)):
                return None
            try:
                step = np.linalg.solve(J, r)
            except np.linalg.LinAlgError:
                return None
            move = step[:size].reshape(-1, 6)
            if not np.sum(np.abs(move[:, :3])) * self.h < 2 * np.pi:
                return None
            xi, tension = xi - move, tension - step[size:]
            if np.linalg.norm(weight * move) < BALANCED:
                return xi, tension, self.margin(J)
        return None

    def follow(self) -> Path:
        """Load steps from rest to the full loads and inputs, or as far as they converge."""
        xi, tension = self.rest.copy(), np.zeros(len(self.driven))
        s, step, margin, least, last = 0.0, FIRST_STEP, Margin(1.0, 1.0), 1.0, (xi, tension, 0.0)
        while s < 1 and least > 0 and step > LEAST_STEP:
            there = min(1.0, s + step)
            ahead = (there - s) / (s - last[2]) if s > 0 else 0.0
            found = self.balance(
                xi + ahead * (xi - last[0]), tension + ahead * (tension - last[1]), there
            )
            far = found is None or np.sum(np.abs(found[0] - xi)[:, :3]) * self.h > MOST_TURN
            if found is None or far or (found[2].real <= 0 and step > 2 * LEAST_STEP):
                step /= 2
                continue
            last = (xi, tension, s)
            (xi, tension, margin), s, step = found, there, 1.5 * step
            least = min(least, margin.real)
        return Path(s, margin, least, xi, tension)

    def tip(self, xi: np.ndarray) -> np.ndarray:
        """Position of the tip, in units of L."""
        return self.poses(xi)[0][-1, :3, 3]

    def turn(self, xi: np.ndarray) -> float:
        """Total bending of the arm [rad]."""
        return float(np.sum(np.linalg.norm((xi - self.rest)[:, 1:3], axis=1)) * self.h)


def _lower(count: int) -> np.ndarray:
    """Mask of the entries of the tangent that belong to an element and an earlier one."""
    place = np.repeat(np.arange(count), 6)
    return place[:, None] > place


def skew(v: np.ndarray) -> np.ndarray:
    """Matrices of vector products."""
    x, y, z = np.moveaxis(v, -1, 0)
    zero = np.zeros_like(x)
    return np.stack(
        [np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2
    )


def _adjoint(g: np.ndarray) -> np.ndarray:
    R, r = g[:, :3, :3], g[:, :3, 3]
    return np.concatenate([np.concatenate([R, 0 * R], 2), np.concatenate([skew(r) @ R, R], 2)], 1)


def _turned(w: np.ndarray) -> np.ndarray:
    """Matrix that maps a twist to the change of a wrench, $ad(\\eta)^T w$."""
    M, F = skew(w[:, :3]), skew(w[:, 3:])
    return np.concatenate([np.concatenate([M, F], 2), np.concatenate([F, 0 * F], 2)], 1)


def twists(x: np.ndarray) -> np.ndarray:
    """Poses of twists, by Rodrigues' formula."""
    k, u = x[:, :3], x[:, 3:]
    square = np.sum(k**2, 1)[:, None, None]
    angle = np.sqrt(np.maximum(square, 1e-16))
    a, b, c = (
        np.sin(angle) / angle,
        (1 - np.cos(angle)) / angle**2,
        (angle - np.sin(angle)) / angle**3,
    )
    small = square < 1e-6
    a, b, c = (
        np.where(small, 1 - square / 6, a),
        np.where(small, 0.5 - square / 24, b),
        np.where(small, 1 / 6 - square / 120, c),
    )
    K = skew(k)
    g = np.zeros((len(x), 4, 4))
    g[:, 3, 3] = 1
    g[:, :3, :3] = np.eye(3) + a * K + b * (K @ K)
    g[:, :3, 3] = ((np.eye(3) + b * K + c * (K @ K)) @ u[:, :, None])[..., 0]
    return g

r"""Six flexible rods that carry a plate, as arms of an assembly and by an independent solution.

The independent one is shooting in SciPy: the moment and the force at the base of each rod, and the
pose of the plate, are 42 unknowns; each rod is integrated from its base with

$$r' = R \upsilon, \quad R' = R \hat\kappa, \quad m' = -r' \times n, \quad n' = 0, \quad
\Sigma (\kappa, \upsilon - e_x) = R^T (m, n),$$

and the rows say that the rods end in the plate, and that the plate is in balance. Only the
stiffness of a section is taken from the package.
"""

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import vsr_jax as vsr

UP = Rotation.from_matrix([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]).inv()
"""Rotation of the sections of a rod that points up."""


def at(position, rotation=None):
    """A pose by its position and its rotation."""
    pose = np.eye(4)
    pose[:3, :3] = np.eye(3) if rotation is None else rotation.as_matrix()
    pose[:3, 3] = position
    return pose


HEIGHT, BASE, PLATE = 0.3, 0.06, 0.05
WEIGHT = 0.4 * 9.81


def anchors():
    """Places of the rods on the ground and on the plate [m]."""
    angles = 2 * np.pi / 6 * np.arange(6)
    twist = np.where(np.arange(6) % 2, 0.25, -0.25)
    return [
        (BASE * np.array([np.cos(a), np.sin(a), 0]), PLATE * np.array([np.cos(b), np.sin(b), 0]))
        for a, b in zip(angles, angles + twist, strict=True)
    ]


def hexapod(places=None):
    """Six nylon rods that motors push out of the ground, with a plate on them."""
    arms, joints = [], []
    for k, (p, q) in enumerate(anchors()):
        q = q if places is None else places[k]
        material = vsr.Material(2e9, poisson=0.4, density=1150.0)
        leg = vsr.Rod(HEIGHT, vsr.Circular(0.002), material, base=at(p, UP))
        arms.append(vsr.Scene(leg, driven=vsr.Input("rod.length", low=0.1, high=0.5)))
        pose = jnp.asarray(at([0, 0, 0], UP)).at[:3, 3].set(jnp.asarray(q))
        joints.append(vsr.Joint(k, 0, pose=pose))
    plate = vsr.Body(at([0, 0, 0.998 * HEIGHT]), mass=0.4)
    return vsr.Assembly(arms, plate, joints)


LENGTHS = HEIGHT + np.array([0.01, -0.005, 0.015, 0.0, 0.01, -0.01])


def tip_of(leg, length, wrench):
    """Place and rotation of the tip of a leg without weight, and the moment and force there, by
    those at its base."""
    base, stiffness = np.asarray(leg.rod.base), np.asarray(leg.rod.stiffness(0.0))
    m0, n = wrench[:3], wrench[3:]

    def slope(_, y):
        R, m = y[3:12].reshape(3, 3), y[12:]
        strain = np.concatenate([R.T @ m, R.T @ n]) / stiffness + [0, 0, 0, 1, 0, 0]
        u = R @ strain[3:]
        w = R @ strain[:3]
        turn = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]) @ R
        return np.concatenate([u, turn.ravel(), -np.cross(u, n)])

    start = np.concatenate([base[:3, 3], base[:3, :3].ravel(), m0])
    y = solve_ivp(slope, (0, length), start, method="DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
    return y[:3], y[3:12].reshape(3, 3), np.concatenate([y[12:], n])


def shooting(assembly, lengths, guess, places):
    """Base wrenches of the legs and the pose of the plate (rotation vector, position) by Newton's
    method: 36 rows say that the legs end in the plate, 6 that it is in balance."""

    def ends(z, k):
        return tip_of(assembly.arms[k], lengths[k], z[6 * k : 6 * k + 6])

    def rows(z, legs):
        R, r = Rotation.from_rotvec(z[36:39]).as_matrix(), z[39:]
        found, total = [], np.array([0, 0, 0, 0, 0, -WEIGHT])
        for (place, turn, wrench), q in zip(legs, places, strict=True):
            off = (R @ UP.as_matrix()).T @ turn
            found += [*(place - r - R @ q), *Rotation.from_matrix(off).as_rotvec()]
            # what a leg carries it takes from the plate
            total[:3] -= wrench[:3] + np.cross(R @ q, wrench[3:])
            total[3:] -= wrench[3:]
        return np.array([*found, *total])

    def moved(z, legs, j, step):
        """The rows with one unknown changed: those of a leg change that leg alone."""
        z = z + step * np.eye(42)[j]
        legs = [ends(z, k) if k == j // 6 else leg for k, leg in enumerate(legs)]
        return rows(z, legs)

    z = guess.copy()
    for _ in range(4):
        legs = [ends(z, k) for k in range(6)]
        steps = 1e-6 * np.maximum(1.0, np.abs(z))
        J = [(moved(z, legs, j, h) - moved(z, legs, j, -h)) / (2 * h) for j, h in enumerate(steps)]
        change = np.linalg.solve(np.transpose(J), rows(z, legs))
        z = z - change
        if np.max(np.abs(change)) < 1e-9:
            break
    return z, rows(z, [ends(z, k) for k in range(6)])


def guess_from(eq):
    """The unknowns of the shooting from a solved assembly."""
    wrenches = []
    for arm in eq.arms:
        R = np.asarray(arm.scene.rod.base)[:3, :3]
        inner = np.asarray(arm.reaction(0.0))
        wrenches += [*(R @ inner[:3]), *(R @ inner[3:])]
    turn = Rotation.from_matrix(np.asarray(eq.poses[0, :3, :3])).as_rotvec()
    return np.array([*wrenches, *turn, *np.asarray(eq.poses[0, :3, 3])])

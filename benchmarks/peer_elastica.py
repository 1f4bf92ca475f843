"""PyElastica in `bench_peers`: damped dynamics until the arm is at rest, the usual way to obtain a
static solution with PyElastica.

PyElastica has no tendons. The thread is a polygon through one point per element and the two ends.
At each point its force acts along both adjacent sides, half on each node of the element, with the
torque of its lever arm on the element. The shear stiffness is that of the other tools, without
PyElastica's factor of 27/28.
"""

from typing import Any

import elastica as ea  # pyright: ignore[reportMissingImports]
import numpy as np


class Pull(ea.NoForces):
    """Tension T [N] of a thread at the positions d in the elements, shape (3, elements), in their
    frames."""

    def __init__(self, tension: float, places: np.ndarray):
        super().__init__()
        self.tension, self.places = tension, places

    def apply_forces(self, system: Any, time: float = 0.0) -> None:
        """Adds forces on the nodes, and torques on the elements in their own frames."""
        x, Q, d = system.position_collection, system.director_collection, self.places
        middle = 0.5 * (x[:, :-1] + x[:, 1:])
        arm = np.einsum("jie,je->ie", Q, d)
        points = np.concatenate(
            [x[:, :1] + arm[:, :1], middle + arm, x[:, -1:] + arm[:, -1:]], axis=1
        )
        sides = np.diff(points, axis=1)
        sides /= np.linalg.norm(sides, axis=0)
        force = self.tension * (sides[:, 1:] - sides[:, :-1])
        end = -self.tension * sides[:, -1]
        system.external_forces[:, :-1] += 0.5 * force
        system.external_forces[:, 1:] += 0.5 * force
        system.external_forces[:, -1] += end
        force[:, -1] += end
        system.external_torques += np.cross(d.T, np.einsum("ije,je->ei", Q, force)).T


class Scene(ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Damping):
    """The system that PyElastica integrates."""


def tip(
    scene: dict[str, Any],
    tau: float,
    elements: int,
    seconds: float,
    density: float = 1000.0,
    damping: float = 1.5,
) -> np.ndarray:
    """Position of the tip [m] after `seconds` of simulated time; the density only sets the time
    scale."""
    length, radius, helix = scene["length"], scene["radius"], scene["helix"]
    rod = ea.CosseratRod.straight_rod(
        elements,
        np.zeros(3),
        np.array([1.0, 0.0, 0.0]),
        np.array([0.0, 1.0, 0.0]),
        length,
        radius,
        density,
        youngs_modulus=scene["young"],
        shear_modulus=scene["shear"],
    )
    rod.shear_matrix[0, 0] = rod.shear_matrix[1, 1] = scene["shear"] * np.pi * radius**2
    phi = helix["phase"] + (np.arange(elements) + 0.5) * length / elements / (
        helix["radius"] * np.tan(helix["angle"])
    )
    places = helix["radius"] * np.stack([np.cos(phi), np.sin(phi), 0 * phi])
    step = 0.2 * length / elements / np.sqrt(scene["young"] / density)
    world = Scene()
    world.append(rod)
    world.constrain(rod).using(
        ea.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
    )
    world.add_forcing_to(rod).using(Pull, -tau, places)
    world.dampen(rod).using(
        ea.AnalyticalLinearDamper, uniform_damping_constant=damping, time_step=step
    )
    world.finalize()
    ea.integrate(ea.PositionVerlet(), world, seconds, int(seconds / step), progress_bar=False)
    return rod.position_collection[:, -1].copy()

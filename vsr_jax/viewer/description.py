r"""What is drawn of an equilibrium, from one compiled program: its samples, its loads, strain and
stress at its wall.

At a point $d = (0, y, z)$ of the wall a plane section has the strains

$$\epsilon = \Delta u_x + \Delta k_y z - \Delta k_z y, \quad
\gamma_y = \Delta u_y - \Delta k_x z, \quad \gamma_z = \Delta u_z + \Delta k_x y$$

with $\Delta k = k - k^*$, $\Delta u = u - u^*$, and the von Mises stress
$\sqrt{(E \epsilon)^2 + 3 G^2 (\gamma_y^2 + \gamma_z^2)}$.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arm.rod import Rod
from ..numerics.compiling import program
from ..solution.equilibrium import Equilibrium
from ..solution.summary import Summary
from ..viz.annotate import Acting, Row, rows_from_wrenches, wrenches_of
from ..viz.body import Body, body_from_samples, with_parts

STATIONS = 61


class Shape(NamedTuple):
    """An equilibrium as it is drawn, in NumPy arrays.

    **Fields:** the `equilibrium`; its `body`; the stability `margin`; the longitudinal `strain` [-]
    and the von Mises `stress` [Pa] at the wall, shape (stations, angles); the `loads`.
    """

    equilibrium: Equilibrium
    body: Body
    margin: float
    strain: np.ndarray
    stress: np.ndarray
    loads: list[Row]

    @property
    def tip(self) -> np.ndarray:
        """Position of the tip [m]."""
        return np.asarray(self.body.samples.position[-1])


def shape_of(eq: Equilibrium) -> Shape:
    """The shape of a converged equilibrium."""
    *described, wrenches = _described(eq)
    samples, strain, stress = jax.device_get(described)
    return Shape(
        eq,
        body_from_samples(eq, samples),
        float(samples.values["stability"]),
        strain,
        stress,
        rows_from_wrenches(eq.scene, wrenches),
    )


@program("view")
def _described(eq: Equilibrium) -> tuple[Summary, Array, Array, list[Acting]]:
    X = with_parts(eq.scene, jnp.linspace(0, 1, STATIONS) * eq.scene.rod.length)
    samples = eq.summary(X, ("forces", "stability"))
    return samples, *wall_state(eq.scene.rod, samples), wrenches_of(eq)


def wall_state(
    rod: Rod, samples: Summary
) -> tuple[Float[Array, "stations angles"], Float[Array, "stations angles"]]:
    """Longitudinal strain [-] and von Mises stress [Pa] at the points of the wall of `samples`; NaN
    for stress where no moduli are known."""
    X, length = samples.X, rod.length
    rest = jnp.stack(jax.vmap(rod.rest)(X), axis=-1)
    k, u = jnp.split((samples.strain - rest)[:, None, :], 2, axis=-1)
    from_axis = samples.wall - samples.position[:, None]
    y, z = jnp.moveaxis(jnp.einsum("xai,xij->xaj", from_axis, samples.pose[:, :3, 1:3]), -1, 0)
    strain = u[..., 0] + k[..., 1] * z - k[..., 2] * y
    shear_y, shear_z = u[..., 1] - k[..., 0] * z, u[..., 2] + k[..., 0] * y
    moduli = jax.vmap(lambda x: rod.material.moduli(x, length))(X)
    if moduli is None:
        return strain, jnp.full_like(strain, jnp.nan)
    young, shear = (modulus[:, None] for modulus in moduli)
    stress = jnp.sqrt((young * strain) ** 2 + 3 * shear**2 * (shear_y**2 + shear_z**2))
    return strain, stress

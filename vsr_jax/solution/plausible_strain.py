r"""Doubts about strains: inputs that strain an arm far too much, and strains that are too large for
a linear material, $\max(b\,|k - k^*|, |u - u^*|)$ with the half thickness b.

Each input is checked by the strain that it alone would cause in a section that stays as it is,
$\Sigma^{-1} b_i \tau_i$.
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..arm.rod import Rod
from ..arm.scene import Scene
from ..arm.section_law import CoupledLaw, LinearLaw
from ..mechanics.balance import unit_wrench
from ..numerics.compiling import program
from ..numerics.component import times
from ..validation import is_traced
from .equilibrium import Equilibrium

LARGEST_STRAIN = 0.5
"""Strains of soft silicone stay below it at working loads."""

_FAR = 4 * LARGEST_STRAIN
"""Strain by one input above which it is doubted."""
_STATIONS = 17
"""Stations along the arm: profiles are smooth, so few are enough for a warning."""


def strain_warnings(eq: Equilibrium) -> tuple[str, ...]:
    """Sentences about inputs that strain an arm far too much, or one if the strains of a solved arm
    are too large for a linear material; none for traced solves."""
    rod = eq.scene.rod
    if any(map(is_traced, jax.tree.leaves(eq))) or jnp.ndim(eq.status):
        return ()
    if not isinstance(rod.law(0.5 * rod.length), LinearLaw | CoupledLaw):
        return ()
    if not bool(eq.converged):
        return tuple(_doubtful_inputs(eq))
    largest = float(_largest_strain(eq))
    if largest <= LARGEST_STRAIN:
        return ()
    text = f"strain: up to {largest:.2g}; beyond {LARGEST_STRAIN:g} a linear material is doubtful"
    return (f"{text}; are moduli, sizes and inputs in SI units?",)


def _doubtful_inputs(eq: Equilibrium) -> Iterator[str]:
    """Warns of inputs that alone would strain a section far too much."""
    scene = eq.scene
    if not scene.actuators:
        return
    largest = np.asarray(_strain_by_inputs(scene, eq.inputs))
    for i, (actuator, strain) in enumerate(zip(scene.actuators, largest, strict=True)):
        if strain > _FAR:
            value, unit = float(eq.inputs[i]), actuator.unit
            slip = f"; is it in m{unit}?" if unit == "N" and strain < 1e3 * LARGEST_STRAIN else ""
            yield (
                f"inputs[{i}]: {value:.6g} {unit} would strain a section by {strain:.2g}; beyond "
                f"{LARGEST_STRAIN:g} a linear material is doubtful{slip}"
            )


@program("check")
def _strain_by_inputs(scene: Scene, inputs: Array) -> Array:
    """Largest strain that each input alone causes, to first order; 0 where it drives a law."""
    X = jnp.linspace(0, 1, _STATIONS) * scene.rod.length
    sections, forces, sizes = scene.sections(X), scene.forces(inputs), _sizes(scene.rod, X)
    zero = jnp.zeros_like(scene.rod.length)

    def of_thread(i: int) -> Array:
        if i in scene.law_driven:
            return zero
        path = sections.paths[i]
        wrench = unit_wrench(sections.rest, path)
        parts = zip(sizes, wrench, sections.stiffness, strict=True)
        unit = jnp.stack([jnp.abs(size * part / k) for size, part, k in parts])
        there = times(sections.reach[i], times(sections.flexible, unit))
        return jnp.abs(forces[i]) * jnp.max(there)

    return jnp.stack([of_thread(i) for i in range(len(scene.actuators))])


@program("check")
def _largest_strain(eq: Equilibrium) -> Array:
    nodes = eq.nodes
    sizes = _sizes(eq.scene.rod, nodes.grid.X)
    off = [x - rest for x, rest in zip(nodes.xi, nodes.sections.rest, strict=True)]
    return jnp.max(jnp.stack([jnp.abs(size * x) for size, x in zip(sizes, off, strict=True)]))


def _sizes(rod: Rod, X: Array) -> list[Array]:
    """Factors at abscissas X from the six strain components to strains of the material: the half
    thickness of the section for those that bend and twist it, 1 for the others."""
    zero = jnp.zeros_like(rod.length)
    each = jax.vmap(lambda x: rod.section.clearance(zero, zero, x, rod.length))
    thickness = each(X.reshape(-1)).reshape(X.shape)
    return [thickness] * 3 + [jnp.ones_like(thickness)] * 3

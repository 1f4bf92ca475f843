r"""Warnings about numbers that are far outside of what arms have, most often by a slip of unit:
millimetres for metres, MPa for Pa.

What is looked at: length, half thickness b, slenderness L / b, moduli, density, bores of chambers
and, of a solved arm, the largest strain $\max(b\,|k - k^*|, |u - u^*|)$, beyond which a linear
material is doubtful. Nothing is refused here.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..arm.actuator import Chamber
from ..arm.scene import Scene
from ..solution.equilibrium import Equilibrium
from ..validation import is_traced

LARGEST_STRAIN = 0.5
"""Bending, twist, stretch and shear of soft silicone stay below it at working loads."""

_STATIONS = 17


class _Range(NamedTuple):
    """What arms have, least and most; and by what a number is too great or too small if it is in
    another unit."""

    least: float
    most: float
    unit: str
    slips: tuple[tuple[float, str], ...]

    def holds(self, value: float) -> bool:
        return self.least <= value <= self.most

    def slip(self, value: float) -> str:
        """The units that the number may be in."""
        fitting = [name for factor, name in self.slips if self.holds(value * factor)]
        return f"; is it in {' or '.join(fitting)}?" if fitting else ""


_METRIC = ((1e-3, "millimetres"),)
_PRESSURE = ((1e6, "MPa"), (1e9, "GPa"))
_LENGTH = _Range(1e-3, 20.0, "m", _METRIC)
_THICKNESS = _Range(5e-6, 0.5, "m", _METRIC)
_MODULUS = _Range(1e3, 2e12, "Pa", _PRESSURE)
_DENSITY = _Range(50.0, 25000.0, "kg/m^3", ((1e3, "g/cm^3"),))
_SLENDERNESS = _Range(3.0, 1e4, "", ())


class _Measures(NamedTuple):
    """Half thickness [m], area of the outline [m^2] and the material's numbers along an arm."""

    thickness: Array
    area: Array
    material: dict[str, Array]


def warnings_of(scene: Scene) -> tuple[str, ...]:
    """Sentences about numbers of a scene that are implausible; none while they are traced."""
    return () if _unknown(scene) else tuple(_doubts(scene))


def strain_warnings(eq: Equilibrium) -> tuple[str, ...]:
    """A sentence about strains of a solved arm for which a linear material is doubtful; none while
    it is traced, or if it failed."""
    if _unknown(eq) or jnp.ndim(eq.status) or not bool(eq.converged):
        return ()
    largest = float(_largest_strain(eq))
    if largest <= LARGEST_STRAIN:
        return ()
    said = f"strain: up to {largest:.2g}; beyond {LARGEST_STRAIN:g} a linear material is doubtful"
    return (f"{said}; are moduli, sizes and inputs in SI units?",)


def _unknown(tree: Any) -> bool:
    return any(is_traced(leaf) for leaf in jax.tree.leaves(tree))


def _doubts(scene: Scene) -> Iterator[str]:
    rod, measures = scene.rod, jax.tree.map(np.asarray, _measured(scene))
    length, thickness = float(rod.length), float(np.mean(measures.thickness))
    yield from _outside("rod.length", length, _LENGTH, "arms are 1 mm to 20 m long")
    yield from _outside(
        "rod.section: half thickness", thickness, _THICKNESS, "arms have 5 um to 0.5 m"
    )
    if rod.guide_radius is not None:
        yield from _outside(
            "rod.guide_radius", float(rod.guide_radius), _THICKNESS, "arms have 5 um to 0.5 m"
        )
    slenderness = length / thickness
    if (
        _LENGTH.holds(length)
        and _THICKNESS.holds(thickness)
        and not _SLENDERNESS.holds(slenderness)
    ):
        yield (
            f"rod: {slenderness:.3g} times as long as half its thickness; "
            "rods are 3 to 10000 times; are length and sizes in one unit?"
        )
    for name in ("young", "shear"):
        if name in measures.material:
            yield from _outside(
                f"rod.material.{name}",
                measures.material[name],
                _MODULUS,
                "materials have 1 kPa to 2 TPa",
            )
    if "density" in measures.material:
        yield from _outside(
            "rod.material.density",
            measures.material["density"],
            _DENSITY,
            "materials have 50 to 25000 kg/m^3",
        )
    yield from _moduli(measures.material)
    for i, actuator in enumerate(scene.actuators):
        if isinstance(actuator, Chamber) and float(actuator.area) > np.max(measures.area):
            slip = (
                "; is it in mm^2?" if 1e-6 * float(actuator.area) <= np.max(measures.area) else ""
            )
            yield (
                f"actuators[{i}].area: {float(actuator.area):.6g} m^2; "
                f"the section has {np.max(measures.area):.3g} m^2{slip}"
            )


def _outside(name: str, values: Any, range_: _Range, usual: str) -> Iterator[str]:
    for value in np.atleast_1d(values).tolist():
        if not range_.holds(value):
            yield f"{name}: {value:.6g} {range_.unit}; {usual}{range_.slip(value)}"
            return


def _moduli(material: dict[str, Any]) -> Iterator[str]:
    """Young's and the shear modulus belong to one material, if both are what materials have."""
    if "shear" not in material:
        return
    young, shear = (float(np.mean(material[name])) for name in ("young", "shear"))
    if _MODULUS.holds(young) and _MODULUS.holds(shear) and not 0.01 <= young / shear <= 1000:
        yield (
            f"rod.material: young {young:.6g} Pa and shear {shear:.6g} Pa; "
            "their ratio is 2 to 3 in most materials; are both in Pa?"
        )


@eqx.filter_jit
def _measured(scene: Scene) -> _Measures:
    rod, zero = scene.rod, jnp.zeros_like(scene.rod.length)

    def at(x: Array) -> _Measures:
        thickness = rod.section.clearance(zero, zero, x, rod.length)
        wide = thickness if rod.guide_radius is None else jnp.maximum(thickness, rod.guide_radius)
        area = jnp.maximum(rod.section.geometry(x, rod.length).area, jnp.pi * wide**2)
        return _Measures(
            thickness,
            area,
            {name: value for (name, _), (value, _) in rod.material.limits(x, rod.length).items()},
        )

    return jax.vmap(at)(jnp.linspace(0, 1, _STATIONS) * rod.length)


@eqx.filter_jit
def _largest_strain(eq: Equilibrium) -> Array:
    nodes, rod = eq.nodes, eq.scene.rod
    zero = jnp.zeros_like(rod.length)
    thickness = jax.vmap(lambda x: rod.section.clearance(zero, zero, x, rod.length))(
        nodes.grid.X.reshape(-1)
    ).reshape(nodes.grid.X.shape)
    off = [x - rest for x, rest in zip(nodes.xi, nodes.sections.rest, strict=True)]
    sizes = [thickness] * 3 + [jnp.ones_like(thickness)] * 3
    return jnp.max(jnp.stack([jnp.abs(size * x) for size, x in zip(sizes, off, strict=True)]))

r"""Warnings about implausible numbers, most often a wrong unit: millimetres for metres, MPa for Pa.

Checked are length, half thickness b, slenderness L / b, moduli, density, chamber areas, gravity
and, for a solved arm, the largest strain $\max(b\,|k - k^*|, |u - u^*|)$, above which a linear
material is doubtful. Each input is checked by the strain that it alone would cause in a section
that stays as it is, $\Sigma^{-1} b_i \tau_i$. No number is rejected here.
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ..arm.loads import Gravity
from ..arm.rod import Rod
from ..arm.scene import Scene
from ..arm.section_law import CoupledLaw, LinearLaw
from ..mechanics.balance import unit_wrench
from ..numerics.compiling import program
from ..numerics.component import times
from ..solution.equilibrium import Equilibrium
from ..validation import is_traced

LARGEST_STRAIN = 0.5
"""Strains of soft silicone stay below it at working loads."""

_FAR = 4 * LARGEST_STRAIN
"""Strain by one input above which it is doubted."""
_STATIONS = 17
"""Stations along the arm: profiles are smooth, so few are enough for a warning."""


_PREFIXED = ("m", "Pa")
"""Units that are written with a prefix."""
_PREFIXES = ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "u"))


def _readable(value: float, unit: str) -> str:
    """A number with its unit and the prefix that leaves the fewest digits."""
    if unit not in _PREFIXED:
        return f"{value:g} {unit}"
    factor, prefix = next(pair for pair in _PREFIXES if value >= pair[0])
    return f"{value / factor:g} {prefix}{unit}"


class _Range(NamedTuple):
    """Plausible range of a number, a sentence about it with {} for the range, and factors to SI
    units from units that are often confused."""

    least: float
    most: float
    unit: str
    sentence: str
    slips: tuple[tuple[float, str], ...] = ()

    def contains(self, value: float) -> bool:
        return self.least <= value <= self.most

    @property
    def usual(self) -> str:
        """The sentence with the range."""
        ends = [_readable(end, self.unit) for end in (self.least, self.most)]
        if self.unit not in _PREFIXED:
            ends[0] = f"{self.least:g}"
        return self.sentence.format(" to ".join(ends))

    def doubts(self, name: str, values: np.ndarray | float) -> Iterator[str]:
        """A warning about the first of the values outside the range, with the units it may have."""
        for value in np.atleast_1d(values).tolist():
            if not self.contains(value):
                fitting = [unit for factor, unit in self.slips if self.contains(value * factor)]
                slip = f"; is it in {' or '.join(fitting)}?" if fitting else ""
                yield f"{name}: {value:.6g} {self.unit}; {self.usual}{slip}"
                return


_METRIC = ((1e-3, "millimetres"),)
_LENGTH = _Range(1e-3, 20.0, "m", "arms are {} long", _METRIC)
_THICKNESS = _Range(5e-6, 0.5, "m", "arms have {}", _METRIC)
_SLENDERNESS = _Range(3.0, 1e4, "times", "rods are {}")
_MODULUS = _Range(1e3, 2e12, "Pa", "materials have {}", ((1e6, "MPa"), (1e9, "GPa")))
_GRAVITY = _Range(0.0, 100.0, "m/s^2", "the Earth's is 9.81 m/s^2", ((1e-3, "mm/s^2"),))
_DENSITY = _Range(50.0, 25000.0, "kg/m^3", "materials have {}", ((1e3, "g/cm^3"),))

_RANGES = {
    "rod.length": _LENGTH,
    "rod.section: half thickness": _THICKNESS,
    "rod.discs.radius": _THICKNESS,
    "rod.material.young": _MODULUS,
    "rod.material.shear": _MODULUS,
    "rod.material.density": _DENSITY,
}
"""Ranges of a rod's numbers, by name."""


class _Measures(NamedTuple):
    """Half thickness [m], area of the outline [m^2] and the material's numbers along an arm."""

    thickness: Array
    area: Array
    material: dict[str, Array]


def warnings_of(scene: Scene) -> tuple[str, ...]:
    """Sentences about implausible numbers of a scene; none for traced numbers."""
    return () if _unknown(scene) else tuple(_doubts(scene))


def strain_warnings(eq: Equilibrium) -> tuple[str, ...]:
    """Sentences about inputs that strain an arm far too much, or one if the strains of a solved arm
    are too large for a linear material; none for traced solves."""
    rod = eq.scene.rod
    if _unknown(eq) or jnp.ndim(eq.status):
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


def _unknown(tree: PyTree) -> bool:
    return any(is_traced(leaf) for leaf in jax.tree.leaves(tree))


def _doubts(scene: Scene) -> Iterator[str]:
    rod, measures = scene.rod, jax.tree.map(np.asarray, _measured(scene))
    length, thickness = float(rod.length), float(np.mean(measures.thickness))
    values = {"rod.length": length, "rod.section: half thickness": thickness}
    values |= {f"rod.material.{name}": value for name, value in measures.material.items()}
    if rod.rim is not None:
        values["rod.discs.radius"] = float(rod.rim)
    for name, range_ in _RANGES.items():
        if name in values:
            yield from range_.doubts(name, values[name])
    slenderness = length / thickness
    sized = _LENGTH.contains(length) and _THICKNESS.contains(thickness)
    if sized and not _SLENDERNESS.contains(slenderness):
        yield (
            f"rod: {slenderness:.3g} times as long as half its thickness; {_SLENDERNESS.usual}; "
            "are length and sizes in one unit?"
        )
    yield from _moduli(measures.material)
    yield from _measured_stiffness(measures)
    yield from _gravities(scene)
    for i, actuator in enumerate(scene.actuators):
        area, most = actuator.pressure_area, np.max(measures.area)
        if area is not None and float(area) > most:
            slip = "; is it in mm^2?" if 1e-6 * float(area) <= most else ""
            yield (
                f"actuators[{i}].area: {float(area):.6g} m^2; the section has {most:.3g} m^2{slip}"
            )


def _gravities(scene: Scene) -> Iterator[str]:
    """Warns of gravity that is too large, or points straight up."""
    for i, load in enumerate(scene.loads):
        if isinstance(load, Gravity):
            name, g = f"loads[{i}].acceleration", np.asarray(load.acceleration, float)
            size = float(np.linalg.norm(g))
            yield from _GRAVITY.doubts(name, size)
            if size > 0 and g[2] > 0.999 * size:
                yield f"{name}: points up, along +z; is its sign right?"


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


def _measured_stiffness(measures: _Measures) -> Iterator[str]:
    """Warns of a bending stiffness that material within the outline cannot have beside the axial
    one: $EI / EA$ is the mean square of its distance from the neutral axis."""
    material, most = measures.material, np.max(measures.thickness)
    for name in ("EI_y", "EI_z"):
        if name in material and "EA" in material:
            bending, axial = (float(np.mean(material[x])) for x in (name, "EA"))
            away = np.sqrt(bending / axial)
            if away > most:
                yield (
                    f"rod.material: {name} {bending:.6g} N m^2 and EA {axial:.6g} N; what is stiff "
                    f"would lie {away:.3g} m from the axis, the outline {most:.3g} m; are both in "
                    "SI units?"
                )


def _moduli(material: dict[str, np.ndarray]) -> Iterator[str]:
    """Warns if the ratio of two moduli, each plausible by itself, is implausible."""
    if "shear" not in material:
        return
    young, shear = (float(np.mean(material[name])) for name in ("young", "shear"))
    if _MODULUS.contains(young) and _MODULUS.contains(shear) and not 0.01 <= young / shear <= 1000:
        yield (
            f"rod.material: young {young:.6g} Pa and shear {shear:.6g} Pa; "
            "their ratio is 2 to 3 in most materials; are both in Pa?"
        )


@program("check")
def _measured(scene: Scene) -> _Measures:
    rod, zero = scene.rod, jnp.zeros_like(scene.rod.length)

    def at(x: Array) -> _Measures:
        thickness = rod.section.clearance(zero, zero, x, rod.length)
        wide = thickness if rod.rim is None else jnp.maximum(thickness, rod.rim)
        area = jnp.maximum(rod.section.geometry(x, rod.length).area, jnp.pi * wide**2)
        limits = rod.material.limits(rod.section, x, rod.length)
        return _Measures(
            thickness,
            area,
            {name: value for (name, _), (value, _) in limits.items()},
        )

    return jax.vmap(at)(jnp.linspace(0, 1, _STATIONS) * rod.length)


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

"""A scene: a rod with its actuators and loads, and the quantities that models need at each
cross-section."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..numerics.component import Forces, Vector, Wrench, add
from ..numerics.quadrature import piece_edges
from ..typing import ArrayLike, DTypeLike, Scalar, VectorLike, cast
from ..validation import ROUNDING, concrete, instance, is_traced, numbers, precise
from .actuator import Actuator
from .description import Part, describe, described_arguments, table
from .discs import check_discs, inner_discs, rest_length
from .loads import Frame, Load
from .pose_loads import PoseLoad
from .profile import Limits
from .rod import STRAINS, Rod
from .routing import Path
from .scene_numbers import checked_values, replaced


class CrossSections(NamedTuple):
    r"""Cross-sections at given X: the diagonal of $\Sigma$ (6), $\xi^*$ (6), the `Path` of each
    thread, and its `reach`: 1 between its ends and 0 elsewhere, None if it extends over the whole
    arm."""

    stiffness: Vector
    rest: Vector
    paths: tuple[Path, ...]
    reach: tuple[Array | None, ...]

    def carry(self, forces: Forces) -> Forces:
        """Force of each thread here: equal to that at its start between its ends, else zero."""
        return shared(forces, self.reach)


def shared(forces: Forces, shares: tuple[Array | None, ...]) -> Forces:
    """Forces of threads, each times its share; None means one."""
    return tuple(f if share is None else f * share for f, share in zip(forces, shares, strict=True))


class Scene(Part):
    """A rod with its actuators and loads. Effects that are absent are not computed.

    **Arguments:**
    - `rod`: the arm.
    - `actuators`: `Thread`, `Tendon` and `Chamber` in the order of the inputs.
    - `loads`: `Gravity`, `TipWrench`, `PointWrench` and `DistributedWrench`; with the pose of
      their section change `Spring`, `Payload`, `MagneticMoment`, `MagneticDensity` and `Spinning`.
    - `free_strains`: names of the strains that can change, all six by default. The others equal
      their rest value and are not unknowns of the solve. `("bending_y", "bending_z")` is an
      inextensible rod without twist and shear.

    **Raises:** `ValueError` if

    - a thread is outside the section (or the rod's `guide_radius`),
    - a size, a modulus, a density or the rest elongation is not positive somewhere,
    - a tube has no wall, or Poisson's ratio is out of its range,
    - a thread ends or a load acts beyond the arm,
    - there is gravity and the material has no density.

    Only known numbers are checked, not those traced by `jax.jit`.
    """

    rod: Rod
    actuators: tuple[Actuator, ...]
    loads: tuple[Load, ...]
    free_strains: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        rod: Rod,
        actuators: Sequence[Actuator] | Actuator = (),
        loads: Sequence[Load] | Load = (),
        *,
        free_strains: Sequence[str] = STRAINS,
    ):
        self.rod = instance("Scene.rod", rod, Rod, "a Rod")
        self.actuators = _each(
            "Scene.actuators", actuators, Actuator, "a Thread, Tendon or Chamber"
        )
        self.loads = _each("Scene.loads", loads, Load, "a Gravity, TipWrench, Spring or other load")
        names = (free_strains,) if isinstance(free_strains, str) else tuple(free_strains)
        if not names or any(name not in STRAINS for name in names):
            raise ValueError(
                f"Scene.free_strains: got {free_strains!r}, need some of {', '.join(STRAINS)}"
            )
        self.free_strains = tuple(name for name in STRAINS if name in names)
        for load in self.loads:
            load.check(rod)
        self._check_numbers()

    def __repr__(self) -> str:
        rod = described_arguments(self.rod) if isinstance(self.rod, Part) else []
        rows = [(f"rod.{name}", text) for name, text in rod] or [("rod", describe(self.rod))]
        for name in ("actuators", "loads"):
            parts = getattr(self, name)
            if isinstance(parts, tuple):
                rows += [(f"{name}[{i}]", _line(part)) for i, part in enumerate(parts)]
            else:
                rows.append((name, describe(parts)))
        if self.free_strains != STRAINS:
            rows.append(("free_strains", ", ".join(self.free_strains)))
        return table("Scene", rows)

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects of the scene beyond a bare rod. Other effects add no operations."""
        threads = [actuator.effects for actuator in self.actuators]
        loads = [load.effects for load in self.loads]
        names = [effects[0] for effects in (*threads, *loads)]
        names += [option for effects in loads for option in effects[1:]]
        names += ["sections"] if self.breakpoints else []
        names += [option for effects in threads for option in effects[1:]]
        if len(self.free_strains) < len(STRAINS):
            names.append("only " + ", ".join(self.free_strains))
        return tuple(dict.fromkeys(names))

    @property
    def free(self) -> tuple[int, ...]:
        """Indices of the free strains among the six."""
        return tuple(STRAINS.index(name) for name in self.free_strains)

    @property
    def length_driven(self) -> tuple[int, ...]:
        """Indices of the actuators driven by their length."""
        return tuple(i for i, actuator in enumerate(self.actuators) if actuator.length_driven)

    @property
    def frictional(self) -> tuple[int, ...]:
        """Indices of the actuators with friction."""
        return tuple(i for i, actuator in enumerate(self.actuators) if actuator.frictional)

    @property
    def straight(self) -> tuple[int, ...]:
        """Indices of the actuators that run straight from disc to disc."""
        return tuple(i for i, actuator in enumerate(self.actuators) if actuator.straight)

    @property
    def reacts(self) -> bool:
        """Whether sections bear wrenches from beyond them, of loads or of straight tendons."""
        return bool(self.loads or self.straight)

    @property
    def coupled(self) -> bool:
        """Whether the cross-sections depend on each other: through loads, straight tendons, given
        thread lengths or friction."""
        return bool(self.reacts or self.length_driven or self.frictional)

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        """Abscissas [m] where the strain or one of its derivatives jumps."""
        laid = [x for actuator in self.actuators for x in actuator.breakpoints]
        return (
            *self.rod.breakpoints,
            *laid,
            *inner_discs(self.rod, self.actuators),
            *(x for load in self.loads for x in load.breakpoints(self.rod)),
        )

    def edges(self, more: tuple[Scalar, ...] = ()) -> Float[Array, " edges"]:
        """Ends of the smooth pieces of the arm [m], `more` breakpoints included."""
        return piece_edges(self.rod.length, (*self.breakpoints, *more))

    def sections(self, X: Array) -> CrossSections:
        """Stiffness, rest strain and thread paths at abscissas X of any shape, in component arrays
        of that shape."""

        def at(x: Scalar) -> CrossSections:
            paths = tuple(actuator.routing.path(x) for actuator in self.actuators)
            reach = tuple(actuator.reach(x) for actuator in self.actuators)
            return CrossSections(self.rod.stiffness(x), self.rod.rest(x), paths, reach)

        if X.ndim == 0:
            return at(X)
        nodes = jax.vmap(at)(X.reshape(-1))
        return jax.tree.map(lambda leaf: leaf.reshape(X.shape), nodes)

    def forces(self, inputs: Float[Array, " inputs"]) -> Forces:
        r"""Signed thread forces $\tau$ [N] for the inputs, one scalar per thread."""
        return tuple(
            actuator.force(value) for actuator, value in zip(self.actuators, inputs, strict=True)
        )

    def density(self, X: Array, frame: Frame) -> Wrench | None:
        """Sum $(c, f)$ of the loads per length of a frame at abscissas X of any shape; None
        if there are none."""
        total = None
        for load in self._fixed(frame):
            if load.point(self.rod) is not None:
                continue
            here = jax.vmap(lambda x, load=load: load.density(self.rod, x) or ())(X.reshape(-1))
            here = jax.tree.map(lambda x: jnp.broadcast_to(x, X.size).reshape(X.shape), here)
            total = here if total is None else add(total, here)
        return total

    def point_wrenches(self, frame: Frame) -> tuple[tuple[Scalar, Wrench], ...]:
        """Abscissa and wrench $(M, F)$ of each load of a frame that acts at a point."""
        points = [load.point(self.rod) for load in self._fixed(frame)]
        return tuple(point for point in points if point is not None)

    def _fixed(self, frame: Frame) -> list[Load]:
        """The loads whose wrench is constant in a frame."""
        return [x for x in self.loads if x.frame == frame and not isinstance(x, PoseLoad)]

    @property
    def pose_loads(self) -> tuple[PoseLoad, ...]:
        """The loads that depend on the pose of their section."""
        return tuple(load for load in self.loads if isinstance(load, PoseLoad))

    @property
    def needs_positions(self) -> bool:
        """Whether some load depends on the positions of the sections."""
        return any(load.needs == "pose" for load in self.pose_loads)

    def admits(self, inputs: Float[Array, " inputs"]) -> Bool[Array, ""]:
        """Whether every input is finite and in its actuator's range."""
        checks = [
            actuator.admits(value) for actuator, value in zip(self.actuators, inputs, strict=True)
        ]
        return jnp.all(jnp.stack(checks)) if checks else jnp.array(True)

    def check_inputs(self, inputs: VectorLike) -> Float[Array, " inputs"]:
        """`inputs` as an array, one number per actuator.

        **Raises:** `ValueError` for a wrong number of inputs and, if their values are known, for
        NaN, infinities and values outside an actuator's range.
        """
        array = numbers("inputs", inputs, None, finite=False)
        if array.shape != (len(self.actuators),):
            kinds = ", ".join(type(actuator).__name__ for actuator in self.actuators)
            needed = (
                f"({len(self.actuators)},), one number each for {kinds}"
                if kinds
                else "(0,), an empty list: the scene has no actuators"
            )
            raise ValueError(
                f"inputs: got shape {array.shape}, need {needed}; for a batch use jax.vmap"
            )
        known = concrete(array)
        if known is None:
            return array
        for i, (actuator, value) in enumerate(zip(self.actuators, known, strict=True)):
            if not (np.isfinite(value) and value >= actuator.lowest):
                needed = (
                    "a finite number"
                    if np.isinf(actuator.lowest)
                    else f"a finite number >= {actuator.lowest:g}"
                )
                raise ValueError(
                    f"inputs[{i}]: got {value:g}, need {needed} [{actuator.unit}] for a "
                    f"{type(actuator).__name__}"
                )
        for i in self.length_driven:
            length = concrete(self.rest_length(i))
            if length is not None and not known[i] > -length:
                raise ValueError(
                    f"inputs[{i}]: got {known[i]:g}, need a change of length > {-length:g} m, the "
                    f"negative of the tendon's length at rest"
                )
        return array

    def rest_length(self, place: int) -> Scalar:
        """Length of a thread's path at rest [m]."""
        return rest_length(self.rod, self.actuators[place])

    def replace(
        self,
        name: str | Mapping[str, ArrayLike | VectorLike],
        value: ArrayLike | VectorLike | None = None,
    ) -> "Scene":
        """The scene with other numbers: `scene.replace("rod.material.young", 6e5)`, or several by
        `scene.replace({"rod.length": 0.3, "actuators[*].routing.radius": 0.004})`.

        `jax.jit`, `jax.vmap` and `jax.grad` go through the new values.

        **Arguments:**
        - `name`: a name of `vsr_jax.parameters`, where `[*]` stands for every index; or a mapping
          from names to values.
        - `value`: of the shape of the number, or one number for all of an array. It takes the
          precision of the number that it replaces.

        **Raises:** `ValueError` for an unknown name (with the nearest one), a wrong shape, and
        known numbers that no scene may have, as above.
        """
        if isinstance(name, Mapping) and value is None:
            values = name
        elif isinstance(name, str) and value is not None:
            values = {name: value}
        else:
            raise ValueError(
                f"Scene.replace: got {name!r} and {value!r}, need a name and a value, or a mapping "
                f"from names to values"
            )
        scene = replaced(self, checked_values(self, values))
        scene._check_numbers()
        return scene

    def astype(self, dtype: DTypeLike) -> "Scene":
        """The same scene with its floating-point numbers in `dtype`, float32 or float64."""
        precise("dtype", jnp.zeros((), dtype))
        return cast(self, dtype)

    def _check_numbers(self) -> None:
        if any(is_traced(leaf) for leaf in jax.tree.leaves((self.rod, self.actuators, self.loads))):
            return
        length = float(numbers("Scene.rod.length", self.rod.length, positive=True))
        self._check_places(length)
        probe = jax.tree.map(concrete, _probe(self))
        if probe[0] is None:
            return
        X, limited, clearances = probe
        for (name, needed), (values, room) in limited.items():
            if not np.all(room > 0):
                i, unit = int(np.argmin(room)), " m" if name.startswith("section") else ""
                raise ValueError(
                    f"Scene.rod.{name}: got {values[i]:g}{unit} at X = {X[i]:g} m, need {needed} "
                    f"everywhere"
                )
        for i, values in enumerate(clearances):
            j = int(np.argmin(values))
            if not values[j] > -ROUNDING * length:
                guide = self.rod.guide_radius
                outside, needed = (
                    ("section", "the section (or give the rod a guide_radius)")
                    if guide is None
                    else ("section and the guides", f"the guide_radius of {float(guide):g} m")
                )
                raise ValueError(
                    f"Scene.actuators[{i}].routing: the thread is {-values[j]:.3g} m outside the "
                    f"{outside} at X = {X[j]:g} m; need a path inside {needed}"
                )

    def _check_places(self, length: float) -> None:
        """Raises `ValueError` if a thread end or a point load is beyond the arm."""
        beyond = length * (1 + ROUNDING)
        for i, actuator in enumerate(self.actuators):
            for name, x in (("start", actuator.start), ("end", actuator.end)):
                if x is not None and (
                    float(x) > beyond or (name == "start" and float(x) >= length)
                ):
                    raise ValueError(
                        f"Scene.actuators[{i}].{name}: got {float(x):g} m, need a place on the "
                        f"arm of {length:g} m"
                    )
            if actuator.straight:
                check_discs(f"Scene.actuators[{i}]", actuator, self.rod.length)
        for i, load in enumerate(self.loads):
            X = load.place(self.rod)
            if X is not None and float(X) > beyond:
                raise ValueError(
                    f"Scene.loads[{i}].X: got {float(X):g} m, need a place on the arm of "
                    f"{length:g} m"
                )


def _line(part: Any) -> str:
    text = describe(part)
    return f"{text}, input in {part.unit}" if isinstance(part, Actuator) else text


def _each(name: str, values: Any, kind: type, needed: str) -> tuple:
    values = (values,) if isinstance(values, kind) else values
    return tuple(instance(f"{name}[{i}]", value, kind, needed) for i, value in enumerate(values))


_PROBES = 65
"""Evenly spaced abscissas at which limits are checked, besides the breakpoints and the middles
between them."""


@eqx.filter_jit
def _probe(scene: Scene) -> tuple[Array, Limits, list[Array]]:
    """Abscissas X [m] along the arm and, at each, the numbers of the rod that have limits and the
    clearance of each thread [m]."""
    rod = scene.rod
    # between the breakpoints too, where a short piece may lie between evenly spaced abscissas
    edges = scene.edges()
    X = jnp.concatenate(
        [jnp.linspace(0, 1, _PROBES) * rod.length, edges, 0.5 * (edges[1:] + edges[:-1])]
    )

    def clearance(actuator: Actuator, x: Scalar) -> Array:
        inside, reach = rod.clearance(*actuator.routing(x), x), actuator.reach(x)
        return inside if reach is None else jnp.where(reach > 0, inside, jnp.inf)

    return (
        X,
        jax.vmap(rod.limits)(X),
        [jax.vmap(lambda x, a=a: clearance(a, x))(X) for a in scene.actuators],
    )

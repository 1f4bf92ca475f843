"""A scene: a rod with its actuators and loads, and the quantities that models need at each
cross-section."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..numerics.component import Forces, Matrix, Tree, Vector, Wrench, add, subtract
from ..numerics.quadrature import piece_edges
from ..numerics.stacked import stack
from ..typing import ArrayLike, DTypeLike, Scalar, ScalarLike, VectorLike, cast, real
from ..validation import concrete, instance, instances, is_traced, numbers, precise
from .actuator import Actuator
from .description import Part, describe, described_arguments, table
from .driven import Input, InputRange, driven_by, rest_of, with_driven
from .held import Support
from .loads import Frame, Load
from .obstacles import Obstacle
from .plausible import quietly, warn
from .pose_loads import PoseLoad
from .rod import STRAINS, Rod
from .routing import Path
from .scene_checks import check_held, check_numbers, check_obstacles
from .scene_numbers import checked_values, replaced
from .section_law import SectionLaw
from .thread_lines import rest_length

_LENGTH = "rod.length", 0


class CrossSections(NamedTuple):
    r"""Cross-sections at given X: the diagonal of $\Sigma$ (6), $\xi^*$ (6), the `Path` of each
    thread, and its `reach`: 1 between its ends and 0 elsewhere, None if it extends over the whole
    arm; `flexible`: 0 on rigid pieces and 1 elsewhere, None without rigid pieces; the `law` of the
    sections, of which $\Sigma$ is the tangent at rest."""

    stiffness: Vector
    rest: Vector
    paths: tuple[Path, ...]
    reach: tuple[Array | None, ...]
    flexible: Array | None
    law: SectionLaw

    def elastic_wrench(self, xi: Vector) -> Vector:
        """Moment and force by the strain."""
        return self.law.wrench(subtract(xi, self.rest), self.stiffness)

    def elastic_tangent(self, xi: Vector) -> Matrix:
        """Lower triangle of the derivative of `elastic_wrench`."""
        return self.law.tangent(subtract(xi, self.rest), self.stiffness)

    def elastic_energy(self, xi: Vector) -> Array:
        """Energy per length of the arm [J/m]."""
        return self.law.energy(subtract(xi, self.rest), self.stiffness)

    def carry(self, forces: Forces) -> Forces:
        """Force of each thread here: equal to that at its start between its ends, else zero."""
        return shared(forces, self.reach)

    @property
    def every_path(self) -> Path:
        """The paths of all threads, `together`."""
        return Path(*(together(same) for same in zip(*self.paths, strict=True)))

    @property
    def every_reach(self) -> Array | None:
        """The reach of all threads, `together`; None if all extend over the whole arm."""
        if all(x is None for x in self.reach):
            return None
        whole = jnp.ones_like(self.paths[0].y)
        return together(tuple(whole if x is None else x for x in self.reach))


def together(parts: tuple[Array, ...]) -> Array:
    """What belongs to several threads on a first axis; of one alone, its own."""
    return parts[0] if len(parts) == 1 else stack(parts)


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
    - `held`: sections that are pinned, clamped or guided in space, `Held`.
    - `free_strains`: names of the strains that can change, all six by default. The others equal
      their rest value and are not unknowns of the solve; so do those for which the rod has a
      `Stiffness` without a number. `("bending_y", "bending_z")` is an inextensible rod without
      twist and shear.
    - `obstacles`: `Plane`, `Sphere`, `Cylinder`, `Box`, `Tube` and `Field`, rigid and fixed.
    - `driven`: numbers of the scene that are inputs too, after those of the actuators, `Input`.

    **Raises:** `ValueError` if

    - a thread is outside the section (or the rod's discs),
    - a size, a modulus, a density or the rest elongation is not positive somewhere,
    - a tube has no wall, or Poisson's ratio is out of its range,
    - a thread ends or a load acts beyond the arm,
    - a rigid piece is beyond the arm, two of them overlap, or they cover all of the arm,
    - a straight tendon has no discs, or does not start and end in discs,
    - there is gravity, and the material has no density or the stiffness no mass,
    - an obstacle has no size, a tube is narrower than the arm, or the arm starts inside an obstacle
      or outside a tube,
    - a driven number does not exist, or two inputs drive it.

    **Warns:** `UnitWarning` of numbers far outside of what arms have, such as `length=400`.

    Only known numbers are checked, not those traced by `jax.jit`.
    """

    rod: Rod
    actuators: tuple[Actuator, ...]
    loads: tuple[Load, ...]
    held: tuple[Support, ...]
    free_strains: tuple[str, ...] = eqx.field(static=True)
    obstacles: tuple[Obstacle, ...]
    driven: tuple[Input, ...]

    def __init__(
        self,
        rod: Rod,
        actuators: Sequence[Actuator] | Actuator = (),
        loads: Sequence[Load] | Load = (),
        *,
        held: Sequence[Support] | Support = (),
        free_strains: Sequence[str] = STRAINS,
        obstacles: Sequence[Obstacle] | Obstacle = (),
        driven: Sequence[Input] | Input = (),
    ):
        self.rod = instance("Scene.rod", rod, Rod, "a Rod")
        self.actuators = instances(
            "Scene.actuators", actuators, Actuator, "a Thread, Tendon or Chamber"
        )
        self.loads = instances(
            "Scene.loads", loads, Load, "a Gravity, TipWrench, Spring or other load"
        )
        self.held = instances("Scene.held", held, Support, "a Held")
        names = (free_strains,) if isinstance(free_strains, str) else tuple(free_strains)
        if not names or any(name not in STRAINS for name in names):
            raise ValueError(
                f"Scene.free_strains: got {free_strains!r}, need some of {', '.join(STRAINS)}"
            )
        locked = rod.material.locked
        self.free_strains = tuple(x for x in STRAINS if x in names and x not in locked)
        if not self.free_strains:
            raise ValueError(
                f"Scene.free_strains: got {free_strains!r} and a rod without stiffness for "
                f"{', '.join(locked)}; need a strain that can change"
            )
        self.obstacles = instances(
            "Scene.obstacles", obstacles, Obstacle, "a Plane, Sphere, Tube or other obstacle"
        )
        self.driven = instances("Scene.driven", driven, Input, "an Input")
        if rod.base is None and any(x.startswith("rod.base") for i in self.driven for x in i.names):
            still = jnp.eye(4, dtype=rod.length.dtype)
            self.rod = eqx.tree_at(lambda r: r.base, rod, still, is_leaf=lambda x: x is None)
        driven_by(self, self.driven)
        for load in self.loads:
            load.check(rod)
        self._check_numbers()

    def __repr__(self) -> str:
        rod = described_arguments(self.rod) if isinstance(self.rod, Part) else []
        rows = [(f"rod.{name}", text) for name, text in rod] or [("rod", describe(self.rod))]
        for name in ("actuators", "loads", "held", "obstacles", "driven"):
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
        names += [held.effect for held in self.held]
        names += [obstacle.effect for obstacle in self.obstacles]
        names += [option for effects in loads for option in effects[1:]]
        names += [self.rod.material.effect] if self.rod.material.effect else []
        names += ["sections"] if self.breakpoints else []
        names += ["rigid pieces"] if self.rod.stiffened else []
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
    def law_driven(self) -> tuple[int, ...]:
        """Indices of the actuators whose force is an unknown, which follows from their law."""
        return tuple(i for i, actuator in enumerate(self.actuators) if actuator.law_driven)

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
        return bool(self.loaded or self.straight)

    @property
    def coupled(self) -> bool:
        """Whether the cross-sections depend on each other: through loads, held sections, obstacles,
        straight tendons, laws of actuators (as of given lengths) or friction."""
        return bool(self.reacts or self.law_driven or self.frictional)

    @property
    def loaded(self) -> bool:
        """Whether anything but the threads exerts wrenches on the arm: loads, held sections and
        obstacles."""
        return bool(self.loads or self.held or self.obstacles)

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        """Abscissas [m] where the strain or one of its derivatives jumps."""
        laid = [x for actuator in self.actuators for x in actuator.breakpoints]
        return (
            *self.rod.breakpoints,
            *laid,
            *self._acting_discs,
            *(x for load in self.loads for x in load.breakpoints(self.rod)),
            *(held.X for held in self.held if held.X is not None),
        )

    @property
    def _acting_discs(self) -> tuple[Scalar, ...]:
        """Abscissas [m] of the faces of discs before the tip, where these are more than guides."""
        discs = self.rod.discs
        if discs is None:
            return ()
        weighed = discs.mass is not None and bool(self.loads)
        if not (self.straight or weighed or discs.thickness is not None):
            return ()
        X = discs.faces(self.rod.length)
        return tuple(X[i] for i in range(X.size if discs.number is None else X.size - 1))

    def edges(self, more: Sequence[ScalarLike] = ()) -> Float[Array, " edges"]:
        """Ends of the smooth pieces of the arm [m], `more` breakpoints included."""
        return piece_edges(self.rod.length, (*self.breakpoints, *map(real, more)))

    def sections(self, X: ArrayLike) -> CrossSections:
        """Stiffness, rest strain and thread paths at abscissas X of any shape, in component arrays
        of that shape."""

        def at(x: Scalar) -> CrossSections:
            paths = tuple(actuator.routing.path(x) for actuator in self.actuators)
            reach = tuple(actuator.reach(x) for actuator in self.actuators)
            rod = self.rod
            stiffness, rest, flexible = rod.stiffness(x), rod.rest(x), rod.flexible(x)
            return CrossSections(stiffness, rest, paths, reach, flexible, rod.law(x))

        return _at_each(at, X)

    def thread_reach(self, X: ArrayLike) -> tuple[Array | None, ...]:
        """`CrossSections.reach` at abscissas X of any shape."""

        def at(x: Scalar) -> tuple[Array | None, ...]:
            return tuple(actuator.reach(x) for actuator in self.actuators)

        return _at_each(at, X)

    def forces(self, inputs: VectorLike) -> Forces:
        r"""Signed thread forces $\tau$ [N] for the inputs, one scalar per thread."""
        values = real(inputs)
        return tuple(actuator.force(values[i]) for i, actuator in enumerate(self.actuators))

    def density(self, X: ArrayLike, frame: Frame) -> Wrench | None:
        """Sum $(c, f)$ of the loads per length of a frame at abscissas X of any shape; None
        if there are none."""
        X, total = real(X), None
        for load in self._fixed(frame):
            if load.point(self.rod) is not None:
                continue
            here = jax.vmap(lambda x, load=load: load.density(self.rod, x) or ())(X.reshape(-1))
            here = jax.tree.map(lambda x: jnp.broadcast_to(x, X.size).reshape(X.shape), here)
            total = here if total is None else add(total, here)
        return total

    def point_wrenches(self, frame: Frame) -> tuple[tuple[Scalar, Wrench], ...]:
        """Abscissas and wrenches $(M, F)$ of the loads of a frame that act at points."""
        return tuple(point for load in self._fixed(frame) for point in load.points(self.rod))

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

    @property
    def inputs(self) -> tuple[InputRange, ...]:
        """What each input is: those of the actuators, then the driven numbers."""
        threads = (InputRange(type(a).__name__, a.unit, a.lowest) for a in self.actuators)
        return (*threads, *(one.range for one in driven_by(self, self.driven)))

    @property
    def greatest_length(self) -> Scalar | float:
        """Length of the arm [m]; where an input drives it, its upper bound."""
        ends = [one.range.high for one in driven_by(self, self.driven) if _LENGTH in one.places]
        return ends[0] if ends else self.rod.length

    @property
    def rest_inputs(self) -> Float[Array, " inputs"]:
        """Inputs without effort: zeros of the actuators, and driven numbers as the scene has
        them."""
        dtype = self.rod.length.dtype
        idle = jnp.zeros(len(self.actuators), dtype)
        if not self.driven:
            return idle
        rest = rest_of(self, driven_by(self, self.driven))
        return jnp.concatenate([idle, jnp.stack(rest).astype(dtype)])

    def at(self, inputs: VectorLike) -> "Scene":
        """The scene with its driven numbers at some inputs, without `driven`; itself if it has
        none."""
        if not self.driven:
            return self
        values = real(inputs)[len(self.actuators) :]
        moved = with_driven(self, driven_by(self, self.driven), list(values))
        return eqx.tree_at(lambda scene: scene.driven, moved, ())

    def without_bounds(self) -> "Scene":
        """The scene with driven numbers that have no bounds."""
        free = tuple(Input(one.number) for one in self.driven)
        return eqx.tree_at(lambda scene: scene.driven, self, free) if free else self

    def admits(self, inputs: VectorLike) -> Bool[Array, ""]:
        """Whether every input is finite and in its range."""
        inputs = real(inputs)
        low, high = (np.array([getattr(x, end) for x in self.inputs]) for end in ("low", "high"))
        within = jnp.isfinite(inputs) & (inputs >= low.astype(inputs.dtype))
        if np.any(high < np.inf):
            within &= inputs <= high.astype(inputs.dtype)
        return jnp.all(within)

    def check_inputs(self, inputs: VectorLike) -> Float[Array, " inputs"]:
        """`inputs` as an array, one number per actuator and driven number.

        **Raises:** `ValueError` for a wrong number of inputs and, if their values are known, for
        NaN, infinities, values outside their range, and driven numbers that no scene may have.
        """
        array, known_inputs = numbers("inputs", inputs, None, finite=False), self.inputs
        if array.shape != (len(known_inputs),):
            kinds = ", ".join(one.name for one in known_inputs)
            needed = (
                f"({len(known_inputs)},), one number each for {kinds}"
                if kinds
                else "(0,), an empty list: the scene has no actuators"
            )
            raise ValueError(
                f"inputs: got shape {array.shape}, need {needed}; for a batch use jax.vmap"
            )
        known = concrete(array)
        if known is None:
            return array
        for i, (one, value) in enumerate(zip(known_inputs, known, strict=True)):
            if not (np.isfinite(value) and one.low <= value <= one.high):
                low = "" if np.isinf(one.low) else f" >= {one.low:g}"
                high = "" if np.isinf(one.high) else f" <= {one.high:g}"
                needed = f"a finite number{low}{' and' * bool(low and high)}{high}"
                raise ValueError(
                    f"inputs[{i}]: got {value:g}, need {needed} [{one.unit}] for a {one.name}"
                )
        if self.driven:
            with quietly():
                self.at(array)._check_numbers()
        for i in self.length_driven:
            length = concrete(self.rest_length(i))
            change = concrete(self.actuators[i].free_length(0.0, known[i]))
            if length is not None and change is not None and not change > -length:
                raise ValueError(
                    f"inputs[{i}]: got {known[i]:g} {self.actuators[i].unit}, need a change of "
                    f"length > {-length:g} m, the negative of the tendon's length at rest"
                )
        return array

    def rest_length(self, place: int) -> Scalar:
        """Length of a thread's path at rest [m]."""
        return rest_length(self.rod, self.actuators[place])

    def replace(
        self,
        name: str | Mapping[str, ArrayLike],
        value: ArrayLike | None = None,
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

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about implausible numbers, most often a wrong unit; none for traced numbers and
        for a batch."""
        if jnp.ndim(self.rod.length) or any(map(is_traced, jax.tree.leaves(self))):
            return ()
        return check_numbers(self.rod, self.actuators, self.loads, self.edges)

    def _check_numbers(self) -> None:
        if not any(map(is_traced, jax.tree.leaves(self))):
            warn(check_numbers(self.rod, self.actuators, self.loads, self.edges))
            check_held(self.rod, self.held)
            check_obstacles(self.rod, self.obstacles, self.edges)


def _at_each(function: Callable[[Scalar], Tree], X: ArrayLike) -> Tree:
    """Values of a function of one abscissa at abscissas X, in arrays of their shape."""
    X = real(X)
    if X.ndim == 0:
        return function(X)
    values = jax.vmap(function)(X.reshape(-1))
    return jax.tree.map(lambda leaf: leaf.reshape(X.shape), values)


def _line(part: Any) -> str:
    text = describe(part)
    return f"{text}, input in {part.unit}" if isinstance(part, Actuator) else text

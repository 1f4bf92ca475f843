"""What a workshop needs of an arm: its body, thread curves, a drilling plan, a bill of lengths."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arm.plausible import quietly
from ..arm.scene import Scene
from ..numerics.compiling import program
from ..numerics.component import norm
from ..solution.equilibrium import Equilibrium
from ..solution.solver import solve
from ..typing import ArrayLike, PathLike, VectorLike
from ..validation import concrete, count, instance, numbers, on_arm, positive
from .body import Body, body_of, folds, write_stl
from .flat_pattern import write_dxf
from .stations import MILLIMETRES, Stations, stations_of
from .step_file import Curve, write_step
from .tables import Table, hole_table, length_table, part_name, path_table, write_csv
from .walls import Wall, default_bores, walls

USUAL_BORE = 1e-3
"""Bore [m] of cables where the walls allow it."""

LEAST_WALL = 4e-4
"""Wall [m] below which there is a warning by default: the width of a common print nozzle."""

TOLERANCE = 2e-5
"""Default distance [m] of chords from the shape."""

_DISCS = 11
"""Number of discs of the drilling plan where the arm has none."""


@dataclass(frozen=True)
class Fabrication:
    """An arm in one shape, ready to be written to files; the result of `export`.

    **Fields:** `scene`; `stations`, the arm at the abscissas that resolve it, in metres; `bores` of
    the threads [m]; `walls`, the thinnest place between any two holes and from each to the outside,
    thinnest first; `holes`, `lengths`, tables in millimetres and degrees; `warnings`, sentences;
    `tolerance` [m].
    """

    scene: Scene
    stations: Stations
    bores: Float[np.ndarray, " threads"]
    walls: tuple[Wall, ...]
    holes: Table
    lengths: Table
    warnings: tuple[str, ...]
    tolerance: float

    @property
    def paths(self) -> Table:
        """The path of each thread in space and in the section, in millimetres and degrees."""
        return path_table(self.stations)

    def body(self) -> Body:
        """The body with its channels as holes: a closed surface of triangles, in millimetres.

        **Raises:** `ValueError` if a channel meets another one or a wall; `ImportError` without
        manifold3d.
        """
        return body_of(self.scene, self.stations, self.bores, self.walls, self.tolerance)

    def curves(self) -> list[Curve]:
        """The axis and the threads in space, in millimetres, with X as their parameter."""
        at = self.stations
        laid = [np.ones(at.X.size, bool), *at.laid.T]
        points = [at.pose[:, :3, 3], *np.moveaxis(at.threads, 1, 0)]
        kinds = [part_name(actuator) for actuator in self.scene.actuators]
        names = ["axis", *(f"thread {i} ({kind})" for i, kind in enumerate(kinds))]
        return [
            Curve(name, MILLIMETRES * at.X[rows], MILLIMETRES * path[rows], at.piece[rows])
            for name, path, rows in zip(names, points, laid, strict=True)
        ]

    def write(
        self,
        *,
        stl: PathLike | None = None,
        step: PathLike | None = None,
        csv: PathLike | None = None,
        dxf: PathLike | None = None,
        holes: PathLike | None = None,
        lengths: PathLike | None = None,
    ) -> None:
        """Writes the files that are named, see `export`."""
        if stl is not None:
            write_stl(stl, self.body())
        if step is not None:
            write_step(step, Path(step).stem, self.curves())
        if dxf is not None:
            write_dxf(dxf, self.stations, _rest_arc(self.scene, self.stations.X))
        for path, table in ((csv, self.paths), (holes, self.holes), (lengths, self.lengths)):
            if path is not None:
                write_csv(path, table)

    def __str__(self) -> str:
        number = self.stations.X.size
        lines = [f"{number} stations, within {MILLIMETRES * self.tolerance:g} mm"]
        if self.scene.actuators:
            lines += ["holes by disc", str(self.holes), "lengths", str(self.lengths)]
        if self.walls:
            lines.append(f"thinnest: {self.walls[0]}")
        return "\n".join(lines)


def export(
    arm: Scene | Equilibrium,
    *,
    stl: PathLike | None = None,
    step: PathLike | None = None,
    csv: PathLike | None = None,
    dxf: PathLike | None = None,
    holes: PathLike | None = None,
    lengths: PathLike | None = None,
    bore: ArrayLike | None = None,
    wall: float = LEAST_WALL,
    discs: VectorLike | None = None,
    tolerance: float = TOLERANCE,
) -> Fabrication:
    r"""Writes files for the workshop, in millimetres.

    Channels are round across the threads at rest; a bent body has the holes of the body at rest,
    bent with it. A channel goes from the start to the end of its thread, where that runs in the
    material; threads in the open, on discs or in a tube, have none.

    **Arguments:**
    - `arm`: a `Scene` for the arm at rest, without inputs and loads; an `Equilibrium` for the arm
      in that shape.
    - `stl`: the body with its channels as holes, a closed surface of triangles. Discs of known
      radius and thickness are part of it.
    - `step`: the axis and the threads as cubic B-splines, with X [mm] as their parameter.
    - `csv`: the paths of the threads, in space and in the section.
    - `dxf`: the threads at rest, unrolled onto a flat sheath.
    - `holes`: the drilling plan of the discs.
    - `lengths`: the bill of cables and tubes.
    - `bore`: diameters of the channels [m], one for all or one per actuator, None for the default:
      the diameter of a chamber's area; for cables 1 mm, or less where that is more than the least
      distance of the thread from a wall or half the least distance of two threads.
    - `wall`: thickness [m] of walls below which there is a warning. Walls are measured in the
      exported shape.
    - `discs`: number of discs, evenly spaced from base to tip, or their abscissas [m]; by default
      the base and the rod's discs, or 11 even ones where it has none.
    - `tolerance`: distance [m] of chords from the shape; sets the number of stations and of corners
      around.

    **Returns:** a `Fabrication`; `print` of it shows the tables.

    **Raises:** `ValueError` for a batch of equilibria, one that did not converge, traced numbers
    and invalid arguments; for `stl`, if a channel meets another one or a wall. `ImportError`
    without the libraries of `pip install "vsr-jax[fabrication]"`: trimesh and manifold3d for `stl`,
    ezdxf for `dxf`.
    """
    made = fabrication_of(arm, bore=bore, wall=wall, discs=discs, tolerance=tolerance)
    made.write(stl=stl, step=step, csv=csv, dxf=dxf, holes=holes, lengths=lengths)
    for sentence in made.warnings:
        warnings.warn(sentence, stacklevel=2)
    return made


def fabrication_of(
    arm: Scene | Equilibrium,
    *,
    bore: ArrayLike | None = None,
    wall: float = LEAST_WALL,
    discs: VectorLike | None = None,
    tolerance: float = TOLERANCE,
) -> Fabrication:
    """`export` without files; warnings are in the result only."""
    eq = _solved(arm)
    scene = eq.scene if isinstance(arm, Equilibrium) else arm
    within, least = positive("tolerance", tolerance), positive("wall", wall)
    given, X = _given_bores(scene, bore), _places(scene, discs)
    stations = stations_of(eq, scene, within)
    bores = default_bores(stations, given, USUAL_BORE)
    found = walls(stations, bores)
    at_rest = np.asarray(_rest_lengths(scene), float)
    lengths = at_rest, np.asarray(eq.lengths, float) if eq is arm else at_rest
    return Fabrication(
        scene,
        stations,
        bores,
        tuple(found),
        hole_table(scene, X, bores),
        length_table(scene, stations, bores, lengths),
        tuple(_warnings(stations, found, least)),
        within,
    )


def _solved(arm: Scene | Equilibrium) -> Equilibrium:
    instance("arm", arm, Scene | Equilibrium, "a Scene or an Equilibrium")
    if any(concrete(leaf) is None for leaf in jax.tree.leaves(eqx.filter(arm, eqx.is_array))):
        raise ValueError("arm: got traced numbers, need known ones: call export outside of jax.jit")
    if isinstance(arm, Scene):
        with quietly():
            eq = solve(Scene(arm.rod), jnp.zeros(0, arm.rod.length.dtype))
    else:
        eq = arm
    eq.refuse_batch()
    if not bool(eq.converged):
        raise ValueError(f"arm: got a solve that failed ({eq.message}), need a converged one")
    return eq


def _given_bores(scene: Scene, bore: ArrayLike | None) -> Float[np.ndarray, " threads"]:
    """Diameters [m] that are given, by the caller or by a chamber's area; NaN for the others."""
    number = len(scene.actuators)
    known = np.asarray(bore).tolist() if isinstance(bore, np.ndarray | Array) else bore
    values = list(known) if isinstance(known, Sequence) else [known] * number
    if len(values) != number:
        raise ValueError(f"bore: got {bore!r}, need one diameter or {number}, one per actuator")
    areas = [actuator.pressure_area for actuator in scene.actuators]
    usual = [np.nan if area is None else 2 * np.sqrt(float(area) / np.pi) for area in areas]
    return np.array(
        [
            default if value is None else positive(f"bore[{i}]", value)
            for i, (value, default) in enumerate(zip(values, usual, strict=True))
        ]
    )


def _places(scene: Scene, discs: VectorLike | None) -> Float[np.ndarray, " discs"]:
    length = float(scene.rod.length)
    if discs is None:
        own = scene.rod.discs
        return (
            np.linspace(0.0, length, _DISCS)
            if own is None
            else np.concatenate([[0.0], own.along(length)])
        )
    if isinstance(discs, int | np.integer):
        return np.linspace(0.0, length, count("discs", discs, least=2))
    X = np.asarray(numbers("discs", discs, None), float)
    if X.ndim != 1 or X.size == 0:
        raise ValueError(f"discs: got shape {X.shape}, need a number of discs or their abscissas")
    on_arm("discs", X, length)
    return X


def _warnings(stations: Stations, found: Sequence[Wall], least: float) -> list[str]:
    thin = [
        f"{wall}, less than {MILLIMETRES * least:g} mm" for wall in found if wall.thickness < least
    ]
    X = folds(stations)
    if X is not None:
        thin.append(f"sections cross each other at X = {X:.4g} m: no body can be bent so sharply")
    return thin


@program("export")
def _rest_lengths(scene: Scene) -> Float[Array, " threads"]:
    lengths = [scene.rest_length(i) for i in range(len(scene.actuators))]
    return jnp.array(lengths, scene.rod.length.dtype)


def _rest_arc(scene: Scene, X: np.ndarray) -> np.ndarray:
    """Arc length [m] of the axis at rest at the stations, by Simpson's rule between them."""
    X = X.astype(scene.rod.length.dtype)
    ends = np.nextafter(X[:-1], X[1:]), 0.5 * (X[:-1] + X[1:]), np.nextafter(X[1:], X[:-1])
    speed = [np.asarray(_rest_stretch(scene, jnp.asarray(x)), float) for x in ends]
    steps = np.diff(X) * (speed[0] + 4 * speed[1] + speed[2]) / 6
    return np.concatenate(([0.0], np.cumsum(steps)))


@program("export")
def _rest_stretch(scene: Scene, X: Float[Array, " places"]) -> Float[Array, " places"]:
    """Length of the axis per X at rest."""
    return norm(scene.sections(X).rest[3:])

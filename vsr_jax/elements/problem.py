"""What acts on the arm of a scene, on a grid: its loads, and what couples its sections."""

from jaxtyping import Array

from ..arm.scene import Scene
from ..mechanics.applied_load import AppliedLoad, Loading
from ..mechanics.coupling import ArmProblem, Coupling
from ..numerics.quadrature import Grid
from .chords import straight_tendons_of
from .contact import contacts_of
from .driven_threads import driven_threads_of
from .fixed_loads import fixed_loads
from .friction import friction_of
from .hole_friction import hole_friction_of
from .pose_term import pose_terms
from .supports import supports_of


def problem_of(scene: Scene, inputs: Array, grid: Grid) -> ArmProblem:
    """The coupled balance of a scene on a grid."""
    sections = scene.sections(grid.X)
    found: tuple[Coupling | None, ...] = (
        driven_threads_of(scene, inputs, sections, grid),
        friction_of(scene, grid),
        hole_friction_of(scene, grid),
        supports_of(scene, sections, grid),
        contacts_of(scene, sections, grid),
    )
    couplings = tuple(one for one in found if one is not None)
    return ArmProblem(grid, sections, scene.forces(inputs), loading(scene, grid), couplings)


def loading(scene: Scene, grid: Grid) -> Loading | None:
    """The loads and straight tendons of a scene on a grid; None if it has none."""
    if not scene.reacts:
        return None
    loads: tuple[AppliedLoad, ...] = (*fixed_loads(scene, grid), *pose_terms(scene, grid))
    tendons = straight_tendons_of(scene, grid)
    return Loading(loads if tendons is None else (*loads, tendons), scene.rod.frame)

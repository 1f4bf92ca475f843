r"""Search for wrong gradients and refused arms among random scenes with what an arm touches, what
holds it, rigid pieces, straight tendons and loads that depend on the pose.

    python benchmarks/gradient_search_around.py --json benchmarks/results/gradients_around.json

Structures are subsets of the effects below, chosen so that each adds as many on-off combinations of
two effects as possible. Scenes are those of `gradient_search.py` with more in them. Obstacles lie
between the shape at rest and that of the arm without them, so that most are touched, and held
sections near where the free arm has them. Arms that are not solved without obstacles are not drawn.
A function of what `gradient_search.py` observes, the contact forces and the wrenches of supports is
differentiated as in `gradient_check.py`. Points where other contacts push than at the centre are
left out too.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr

try:
    from benchmarks import gradient_check as check, gradient_search as tendons
except ModuleNotFoundError:  # as a script
    import gradient_check as check
    import gradient_search as tendons

SEED = 7
STEPS = vsr.StrainDependent(16)

PLAIN = "gravity", "dead", "follower", "length", "elastic", "chamber", "jumps", "free strains"
"""Effects of `gradient_search.py`."""
MORE = "spring", "payload", "magnet", "discs", "rigid", "held"
OBSTACLES = "plane", "sphere", "cylinder", "box", "field"
EFFECTS = (*PLAIN, *MORE, *OBSTACLES)
OFTEN = 0.4
"""Share of the structures in which an effect is wanted; of obstacles there are at most two."""
PLACES = 60
"""Places tried for an obstacle."""
PUSHES = 1e-6
"""Contact force, as a share of that which bends the arm, above which a contact counts as one."""


class Around(eqx.Module):
    """Signed distance from a ball."""

    centre: jax.Array
    radius: jax.Array

    def __call__(self, point: jax.Array) -> jax.Array:
        return jnp.sqrt(jnp.sum((point - self.centre) ** 2)) - self.radius


class Shape(NamedTuple):
    """Positions of stations along an arm (stations, 3), and its outline there."""

    position: np.ndarray
    outline: np.ndarray


def structures(number: int) -> list[frozenset[str]]:
    """Those that cover the on-off combinations of two effects."""
    random = np.random.default_rng(SEED)

    def candidate() -> frozenset[str]:
        chosen = {name for name in (*PLAIN, *MORE) if random.random() < OFTEN}
        chosen |= set(random.choice(OBSTACLES, random.integers(3), replace=False).tolist())
        return frozenset(chosen | {"length"} if "elastic" in chosen else chosen)

    return check.covering(EFFECTS, 2, candidate, number)


def drawn(effects: frozenset[str], random: np.random.Generator) -> check.Drawn | None:
    """A random scene; None for an arm that is not solved without obstacles, or without a place for
    one."""
    plain = tendons.structure(effects & frozenset(PLAIN))
    scene, inputs, force = tendons.drawn(plain, random)
    length = float(scene.rod.length)
    radius = 0.7 * float(scene.rod.outline(jnp.zeros(())))
    bending = force * length * radius
    arm = tendons.Arm(length, radius, bending)
    rod, actuators = scene.rod, list(scene.actuators)
    if "rigid" in effects:
        first = random.uniform(0.35, 0.5) * length
        rod = vsr.Rod(
            rod.length,
            rod.section,
            rod.material,
            rest_strain=rod.rest_strain,
            base=rod.base,
            rigid=vsr.RigidPiece(first, first + random.uniform(0.08, 0.15) * length),
        )
    if "discs" in effects:
        at, aside = random.uniform(0, 2 * np.pi), random.uniform(0.4, 0.9) * radius
        path = vsr.Parallel(aside * np.cos(at), aside * np.sin(at))
        rod = eqx.tree_at(lambda rod: rod.discs, rod, vsr.Discs(4), is_leaf=lambda x: x is None)
        actuators.append(vsr.Tendon(path, straight=True))
        inputs = jnp.append(inputs, tendons.pull(arm, random))
    loads = [*scene.loads, *pose_loads(effects, arm, random)]
    free: dict[str, Any] = {} if plain.free is None else {"free_strains": plain.free}
    without = vsr.Scene(rod, actuators, loads, **free)
    around = surroundings(effects, without, inputs, random)
    if around is None:
        return None
    return check.Drawn(vsr.Scene(rod, actuators, loads, **free, **around), inputs, force)


def pose_loads(effects: frozenset[str], arm: tendons.Arm, random: np.random.Generator) -> list[Any]:
    """The loads that depend on the pose of their section."""
    uniform, L, unit = random.uniform, arm.length, arm.bending / arm.length**2
    loads: list[Any] = []
    if "spring" in effects:
        anchor = uniform(-0.3, 0.3, 3) + np.array([L, 0, 0])
        place, offset = uniform(0.5, 0.95) * L, uniform(-1, 1, 3) * arm.radius
        stiffness = uniform(0.2, 3) * unit / L
        loads.append(vsr.Spring(anchor, stiffness, place, uniform(0, 0.05), offset))
    if "payload" in effects:
        mass, offset = uniform(0.1, 0.7) * unit / 9.81, uniform(-3, 3, 3) * arm.radius
        loads.append(vsr.Payload(mass, uniform(0.6, 0.95) * L, offset))
    if "magnet" in effects:
        moment, field = uniform(-0.5, 0.5, 3), uniform(-1, 1, 3) * unit * L
        loads.append(vsr.MagneticMoment(moment, field, uniform(0.6, 0.95) * L))
    return loads


def surroundings(
    effects: frozenset[str], scene: vsr.Scene, inputs: jax.Array, random: np.random.Generator
) -> dict[str, list] | None:
    """Held sections and obstacles for a scene without; None if it is not solved, or one has no
    place."""
    found: dict[str, list] = {}
    rest = shape(vsr.Scene(scene.rod, free_strains=scene.free_strains), jnp.zeros(0))
    bent = shape(scene, inputs)
    if rest is None or bent is None:
        return None
    kept = np.zeros((0, 3))
    if "held" in effects:
        place = random.integers(22, 41)
        length = float(scene.rod.length)
        target = bent.position[place] + random.uniform(-0.03, 0.03, 3) * length
        found["held"] = [vsr.Held(place / 40 * length, position=target)]
        held = vsr.Scene(
            scene.rod, scene.actuators, scene.loads, free_strains=scene.free_strains, **found
        )
        bent, kept = shape(held, inputs), target[None]
        if bent is None:
            return None
    obstacles = [obstacle(kind, rest, bent, kept, random) for kind in OBSTACLES if kind in effects]
    if any(one is None for one in obstacles):
        return None
    return found | ({"obstacles": obstacles} if obstacles else {})


def shape(scene: vsr.Scene, inputs: jax.Array) -> Shape | None:
    """The shape of an arm; None if it is not solved."""
    eq = vsr.solve(scene, inputs, model=STEPS)
    if eq.status != vsr.Status.CONVERGED:
        return None
    X = jnp.linspace(0, scene.rod.length, 41)
    return Shape(np.asarray(eq.position(X)), np.asarray(jax.vmap(scene.rod.outline)(X)))


def obstacle(
    kind: str, rest: Shape, bent: Shape, kept: np.ndarray, random: np.random.Generator
) -> Any:
    """An obstacle on the way of a station from rest to where it bends, clear of the arm at rest and
    of positions that are kept; None if none is found."""
    length = float(np.linalg.norm(np.diff(rest.position, axis=0), axis=1).sum())
    for _ in range(PLACES):
        i = random.integers(20, 41)
        way = bent.position[i] - rest.position[i]
        far = float(np.linalg.norm(way))
        ahead = way / max(far, 1e-9) + 0.3 * random.normal(size=3)
        ahead /= np.linalg.norm(ahead)
        moved = random.uniform(0.3, 0.9) * max(ahead @ way, 0.1 * far)
        surface = rest.position[i] + ahead * (rest.outline[i] + moved)
        found = built(kind, surface, ahead, length, random)
        distance = jax.vmap(found.distance)
        apart = np.asarray(distance(jnp.asarray(rest.position))) - 1.05 * rest.outline
        clear = np.asarray(distance(jnp.asarray(kept))) - 1.1 * rest.outline.max()
        if np.all(apart > 0) and np.all(clear > 0):
            return found
    return None


def built(
    kind: str, surface: np.ndarray, ahead: np.ndarray, length: float, random: np.random.Generator
) -> Any:
    """An obstacle that lies ahead of a point of its surface."""
    radius = random.uniform(0.03, 0.3) * length
    side = np.cross(ahead, random.normal(size=3))
    side /= np.linalg.norm(side)
    if kind == "plane":
        return vsr.Plane(-ahead, surface)
    if kind == "box":
        size = random.uniform(0.1, 0.5, 3) * length
        pose = _pose(ahead, side, surface + ahead * size[0] / 2)
        return vsr.Box(size, pose=pose, rounding=0.2 * size.min())
    centre = surface + radius * ahead
    if kind == "cylinder":
        return vsr.Cylinder(radius, pose=_pose(side, ahead, centre))
    if kind == "field":
        return vsr.Field(Around(jnp.asarray(centre), jnp.asarray(radius)))
    return vsr.Sphere(centre, radius)


def _pose(x: np.ndarray, y: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Pose with two axes."""
    pose = np.eye(4)
    pose[:3] = np.stack([x, y, np.cross(x, y), position], axis=1)
    return pose


def observed(eq: vsr.Equilibrium, force: jax.Array) -> check.Observed:
    """That of the arm, the contact forces and the wrenches of supports; which contacts push."""
    numbers, switches = check.observed(eq, force, STEPS.steps)
    unit, parts = 0.01 * force, [numbers]
    if eq.scene.obstacles:
        pushing = eq.contacts.force
        parts.append(jnp.sum(pushing, axis=1) / unit)
        switches = (*switches, pushing > PUSHES * unit)
    if eq.scene.held:
        wrench = eq.supports / jnp.array([0.3, 0.3, 0.3, 1.0, 1.0, 1.0])
        parts.append(wrench.ravel() / unit)
    return check.Observed(jnp.concatenate(parts), switches)


def search(effects: frozenset[str], draws: int) -> list[check.Found]:
    """Derivatives of reproducible random scenes of a structure."""
    random = np.random.default_rng([SEED, *(name in effects for name in EFFECTS)])
    scenes: list[check.Drawn] = []
    while len(scenes) < draws:
        one = drawn(effects, random)
        scenes += [] if one is None else [one]
    program = check.Program(scenes[0], STEPS, random, observed)
    return check.compared(scenes, program, random)


def job(effects: frozenset[str], draws: int) -> check.Job:
    """The search of a structure."""
    names = [name for name in EFFECTS if name in effects]
    return check.Job(", ".join(names), {"effects": names}, partial(search, effects, draws))


def main() -> None:
    """Run the search."""
    options = check.parser(__doc__, draws=8).parse_args()
    jobs = [job(effects, options.draws) for effects in structures(options.structures)]
    check.run(jobs, {"seed": SEED, "steps": STEPS.steps}, options.json)


if __name__ == "__main__":
    main()

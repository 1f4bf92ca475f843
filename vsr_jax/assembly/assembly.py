"""An assembly: arms, bodies, and the joints between them."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arm.description import Part, describe, table
from ..arm.driven import InputRange
from ..arm.plausible import quietly
from ..arm.rod import Rod
from ..arm.scene import Scene
from ..models.strain_dependent import StrainDependent
from ..numerics.compiling import program
from ..numerics.se3 import base_pose, exp, inverse, log
from ..typing import Pose, Scalar, VectorLike
from ..validation import concrete, instances, numbers
from .body import Body
from .joint import Joint

_STANDARD_GRAVITY = (0.0, 0.0, -9.81)


class Assembly(Part):
    """Arms that are joined with rigid bodies, and by them with each other and with the ground.

    Each arm is a scene with actuators, loads and obstacles of its own, whose base is clamped in the
    world unless a joint has it. Two arms are joined by a body without mass between them. Closed
    loops are allowed.

    **Arguments:**
    - `arms`: the scenes.
    - `bodies`: plates, tools, grasped objects.
    - `joints`: between sections of the arms and the bodies or the ground.
    - `gravity`: acceleration [m/s^2] of bodies with a mass. Arms have a `Gravity` of their own.

    **Raises:** `ValueError` for a joint of an arm or a body that does not exist, a section beyond
    its arm or with two joints, a base that is joined to the ground, and a body without joints.
    """

    arms: tuple[Scene, ...]
    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...]
    gravity: Float[Array, "3"] = eqx.field(metadata={"unit": "m/s^2"})
    _rest_poses: tuple[Pose, ...]

    def __init__(
        self,
        arms: Sequence[Scene] | Scene,
        bodies: Sequence[Body] | Body = (),
        joints: Sequence[Joint] | Joint = (),
        *,
        gravity: VectorLike = _STANDARD_GRAVITY,
    ):
        self.arms = instances("Assembly.arms", arms, Scene, "a Scene")
        self.bodies = instances("Assembly.bodies", bodies, Body, "a Body")
        given = instances("Assembly.joints", joints, Joint, "a Joint")
        self.gravity = numbers("Assembly.gravity", gravity, (3,))
        if not self.arms:
            raise ValueError("Assembly.arms: got none, need at least one Scene")
        for i, joint in enumerate(given):
            _check_joint(f"Assembly.joints[{i}]", joint, self.arms, len(self.bodies))
        _check_sections(given, self.arms)
        for i in range(len(self.bodies)):
            if all(joint.body != i for joint in given):
                raise ValueError(f"Assembly.bodies[{i}]: got no joint, need one that holds it")
        rods = [self.arms[joint.arm].rod for joint in given]
        self._rest_poses = tuple(_rest_pose(*pair) for pair in zip(rods, given, strict=True))
        self.joints = tuple(
            self._placed_joint(*pair) for pair in zip(given, self._rest_poses, strict=True)
        )

    def __repr__(self) -> str:
        names = ("arms", "bodies", "joints")
        parts = [(f"{name}[{i}]", x) for name in names for i, x in enumerate(getattr(self, name))]
        return table("Assembly", [(label, describe(part)) for label, part in parts])

    @property
    def inputs(self) -> tuple[InputRange, ...]:
        """What each input is: those of the first arm, of the second, and so on."""
        return tuple(
            one._replace(name=f"arms[{i}] {one.name}")
            for i, arm in enumerate(self.arms)
            for one in arm.inputs
        )

    @property
    def rest_inputs(self) -> Float[Array, " inputs"]:
        """Inputs without effort, as `Scene.rest_inputs`."""
        return jnp.concatenate([arm.rest_inputs for arm in self.arms])

    def split(self, inputs: Array) -> list[Array]:
        """The inputs of each arm."""
        ends = np.cumsum([len(arm.inputs) for arm in self.arms])[:-1]
        return jnp.split(inputs, ends)

    def check_inputs(self, inputs: VectorLike) -> Array:
        """`inputs` as an array. Errors as of `Scene.check_inputs`."""
        values, size = numbers("inputs", inputs, None, finite=False), len(self.inputs)
        if values.shape != (size,):
            raise ValueError(
                f"inputs: got shape {values.shape}, need ({size},), those of one arm after the "
                f"other; for a batch use jax.vmap"
            )
        for i, (arm, own) in enumerate(zip(self.arms, self.split(values), strict=True)):
            try:
                arm.check_inputs(own)
                for j, joint in self.jointed(i):
                    _check_place(f"joints[{j}]", joint, arm.at(own))
            except ValueError as error:
                raise ValueError(f"arms[{i}]: {error}") from None
        return values

    def jointed(self, arm: int) -> list[tuple[int, Joint]]:
        """The joints of an arm with their places in `joints`, that of its base first."""
        found = [(i, joint) for i, joint in enumerate(self.joints) if joint.arm == arm]
        return sorted(found, key=lambda pair: not pair[1].at_base)

    def placed(self, poses: Float[Array, "bodies 4 4"]) -> list[Scene]:
        """The scene of each arm between its joints, with the bodies in some poses."""
        scenes = []
        for i, scene in enumerate(self.arms):
            supports = []
            for _, joint in self.jointed(i):
                frame = joint.in_world(poses)
                if joint.at_base:
                    scene = _based(scene, frame)
                else:
                    supports.append(joint.support(frame))
            held = (*scene.held, *supports)
            scenes.append(eqx.tree_at(lambda s: s.held, scene, held) if supports else scene)
        return scenes

    @property
    def poses(self) -> Float[Array, "bodies 4 4"]:
        """The poses that the bodies have."""
        dtype = self.gravity.dtype
        return (
            jnp.stack([b.pose for b in self.bodies]) if self.bodies else jnp.zeros((0, 4, 4), dtype)
        )

    def _placed_joint(self, joint: Joint, rest: Pose) -> Joint:
        """The joint with a pose: where its section lies at rest, if it has none."""
        if joint.pose is not None:
            return joint
        return joint.moved(self._on_body(joint, rest))

    def _on_body(self, joint: Joint, pose: Pose) -> Pose:
        """A pose in the world on the body of a joint, with the bodies in their own poses."""
        return pose if joint.body is None else inverse(self.bodies[joint.body].pose) @ pose

    def assembled(self, share: Scalar) -> "Assembly":
        """The assembly on the way from arms at rest, which nothing strains, at 0, to itself at 1:
        with each joint moved on its body by a share of the way there from where its section lies at
        rest."""
        joints = []
        for joint, rest in zip(self.joints, self._rest_poses, strict=True):
            assert joint.pose is not None
            first = self._on_body(joint, rest)
            joints.append(joint.moved(first @ exp(share * log(inverse(first) @ joint.pose))))
        return eqx.tree_at(lambda a: a.joints, self, tuple(joints))


def _based(scene: Scene, base: Pose) -> Scene:
    return eqx.tree_at(lambda s: s.rod.base, scene, base, is_leaf=lambda x: x is None)


def _rest_pose(rod: Rod, joint: Joint) -> Pose:
    """Where the section of a joint lies at rest, in the world."""
    if joint.at_base:
        return jnp.asarray(base_pose(rod.frame, rod.length.dtype))
    with quietly():
        bare = Scene(rod)
    return _pose_at_rest(bare, rod.length if joint.X is None else joint.X)


@program("rest pose")
def _pose_at_rest(scene: Scene, X: Scalar) -> Pose:
    model = StrainDependent()
    rest = model.at_rest(scene, X.dtype)
    return model.poses(scene, rest.forces, rest.state, X[None])[0]


def _check_joint(path: str, joint: Joint, arms: Sequence[Scene], bodies: int) -> None:
    if joint.arm >= len(arms):
        raise ValueError(f"{path}.arm: got {joint.arm}, need the index of one of {len(arms)} arms")
    if joint.body is not None and joint.body >= bodies:
        raise ValueError(f"{path}.body: got {joint.body}, need the index of one of {bodies} bodies")
    if joint.at_base and joint.body is None:
        raise ValueError(f"{path}: got a base on the ground, need Rod(base=...) for its pose")
    _check_place(path, joint, arms[joint.arm])


def _check_place(path: str, joint: Joint, arm: Scene) -> None:
    X, length = _known(joint.X), _known(arm.rod.length)
    if X is not None and length is not None and length < X:
        raise ValueError(f"{path}.X: got {X:g} m, need at most {length:g} m, the length of the arm")


def _check_sections(joints: Sequence[Joint], arms: Sequence[Scene]) -> None:
    """Raises `ValueError` for a section that is held twice, so that its rows contradict or
    repeat."""
    taken: dict[tuple[int, float], str] = {}
    for a, arm in enumerate(arms):
        for i, held in enumerate(arm.held):
            X = _known(held.place(arm.rod))
            if X is not None:
                taken[a, X] = f"arms[{a}].held[{i}]"
    for i, joint in enumerate(joints):
        X = _known(arms[joint.arm].rod.length if joint.X is None else joint.X)
        if X is None:
            continue
        place = joint.arm, X
        if place in taken:
            raise ValueError(
                f"Assembly.joints[{i}]: got the section of {taken[place]} again, need one "
                f"joint for each section"
            )
        taken[place] = f"joints[{i}]"


def _known(x: Any) -> float | None:
    known = None if x is None else concrete(x)
    return None if known is None or known.ndim else float(known)

r"""Derivatives of the tip pose with respect to the numbers of a scene, its inputs and a tip wrench.

Small motions of the tip are $(\delta\theta, \delta r)$ in the world's axes: rotation [rad], then
displacement [m]. All derivatives are implicit derivatives of the equilibrium.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arm.loads import TipWrench
from ..arm.scene import Scene
from ..arm.scene_numbers import parameters, replaced
from ..mechanics.balance import tangent
from ..models.base import Near
from ..numerics import component as c
from ..numerics.compiling import program
from ..numerics.component import free_block
from ..numerics.se3 import skew, unskew
from ..solution.equilibrium import Equilibrium
from ..typing import Pose, ScalarLike, VectorLike

_MOST_ROWS = 10
"""Most rows of a printed table."""


class SensitivityRow(NamedTuple):
    """One number of a scene, and the derivative of the tip with respect to it: rotation `turn`
    [rad] and displacement `place` [m] per unit of the number."""

    value: Array
    unit: str
    turn: Float[Array, "3"]
    place: Float[Array, "3"]


class Sensitivity(eqx.Module):
    """Derivatives of the tip with respect to every number of a scene and its inputs.
    `table["rod.length"]` is a `SensitivityRow`. `print(table)` prints the rows with the greatest
    effects, `print(table.text(all=True))` all rows.

    **Fields:** `names`, `units`; `values`, shape (numbers,); `turn` [rad] and `place` [m] per unit
    of the number, shape (numbers, 3).
    """

    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    values: Float[Array, " numbers"]
    turn: Float[Array, "numbers 3"]
    place: Float[Array, "numbers 3"]

    def __getitem__(self, name: str) -> SensitivityRow:
        i = self.names.index(name) if name in self.names else None
        if i is None:
            raise KeyError(f"{name!r}: known are {', '.join(self.names)}")
        return SensitivityRow(self.values[i], self.units[i], self.turn[i], self.place[i])

    @property
    def per_percent(self) -> Float[Array, " numbers"]:
        r"""Displacement of the tip [m] for 1 % of a number, $|p| / 100 \, |\partial r / \partial
        p|$; zero where the number is zero, whatever its derivative."""
        return 0.01 * jnp.abs(self.values) * c.norm(c.split(self.place))

    def text(self, *, all: bool = False) -> str:
        """The rows of the numbers with the greatest displacements per 1 %, the greatest first, and
        how many are not shown; with `all` every row. Those of numbers that are zero have no rank
        and come last, with "-" for the displacement."""
        values, place = np.asarray(self.values), np.asarray(self.place)
        effect = 1e3 * np.asarray(self.per_percent)
        order = np.lexsort((-effect, values == 0))
        shown, rest = (order, []) if all else (order[:_MOST_ROWS], order[_MOST_ROWS:])
        width = max(6, *(len(self.names[i]) for i in shown))
        lines = [
            f"{'number':{width}} {'value':>12}  {'unit':7} {'dx':>10} {'dy':>10} {'dz':>10}   mm "
            f"per 1 %"
        ]
        for i in shown:
            steps = " ".join(f"{x:10.3g}" for x in place[i])
            share = f"{effect[i]:.3g}" if values[i] else "-"
            number = f"{self.names[i]:{width}} {values[i]:12.6g}  {self.units[i] or '?':7}"
            lines.append(f"{number} {steps} {share:>11}")
        lines.append("dx, dy, dz: displacement of the tip [m] per unit of the number")
        ranked = [i for i in rest if values[i]]
        folded = [f"{len(ranked)} of at most {effect[ranked[0]]:.3g} mm per 1 %"] if ranked else []
        if len(rest) > len(ranked):
            folded.append(f"{len(rest) - len(ranked)} of numbers that are zero")
        if folded:
            lines.append(f"rows not shown: {', '.join(folded)}; print(table.text(all=True))")
        return "\n".join(lines)

    __str__ = text


def sensitivity(eq: Equilibrium) -> Sensitivity:
    r"""Derivatives of the tip with respect to every number of the scene and every input,
    $(\partial\theta, \partial r) / \partial p$.

    **Arguments:** `eq`: one solved scene; the result is NaN where it failed.

    **Returns:** a `Sensitivity`, a table by name with units. Arrays have one row per entry.
    """
    known = parameters(eq.scene)
    named = [entry for name, parameter in known.items() for entry in parameter.entries(name)]
    named += [(f"inputs[{i}]", one.unit) for i, one in enumerate(eq.given_scene.inputs)]
    values, turn, place = _by_numbers(eq)
    return Sensitivity(
        tuple(name for name, _ in named), tuple(unit for _, unit in named), values, turn, place
    )


@program("sensitivity")
def _by_numbers(eq: Equilibrium) -> tuple[Array, Array, Array]:
    numbers = {name: parameter.value for name, parameter in parameters(eq.scene).items()}

    def motion(changes: dict[str, Array], inputs: Array) -> Array:
        scene = eq.given_scene.at(inputs)
        known = parameters(scene)
        new = {name: known[name].value + change for name, change in changes.items()}
        return _motion(_moved(eq, replaced(scene, new), inputs).tip, eq.tip)

    none = jax.tree.map(jnp.zeros_like, numbers)
    by_numbers, by_inputs = jax.jacrev(motion, argnums=(0, 1))(none, eq.inputs)
    rows = jnp.concatenate(
        [*(by_numbers[name].reshape(6, -1) for name in numbers), by_inputs], axis=1
    ).T
    values = jnp.concatenate([*(x.reshape(-1) for x in numbers.values()), eq.inputs])
    return values, eq.masked(rows[:, :3]), eq.masked(rows[:, 3:])


def _motion(tip: Pose, here: Pose) -> Float[Array, "6"]:
    """Rotation and displacement from a nearby pose, to first order, in the world's axes."""
    turn = tip[:3, :3] @ jax.lax.stop_gradient(here)[:3, :3].T
    return jnp.concatenate([unskew(turn), tip[:3, 3] - jax.lax.stop_gradient(here)[:3, 3]])


def tip_jacobian(eq: Equilibrium) -> Float[Array, "6 inputs"]:
    r"""Derivative of the tip with respect to the inputs, $J = (\partial\theta, \partial r) /
    \partial u$, in the world's axes.

    **Arguments:** `eq`: one solved scene; the result is NaN where it failed.

    **Returns:** shape (6, inputs) [rad and m per unit of the input].
    """
    return _by_inputs(eq)


@program("tip_jacobian")
def _by_inputs(eq: Equilibrium) -> Array:
    def motion(inputs: Array) -> Array:
        return _motion(_moved(eq, eq.given_scene.at(inputs), inputs).tip, eq.tip)

    return eq.masked(jax.jacfwd(motion)(eq.inputs))


def compliance(eq: Equilibrium) -> Float[Array, "6 6"]:
    r"""Compliance matrix of the tip, $(\delta\theta, \delta r) = C (\delta M, \delta F)$, for a
    small dead wrench on the tip, in the world's axes.

    Without loads, for models that are `balanced_everywhere`, $C = \int G^T (\Sigma - A)^{-1} G \,
    dX$, where G transforms the wrench to the frames of the sections. Where the sections are
    coupled, and for all other models, the derivative of the solve with an additional `TipWrench`.

    **Arguments:** `eq`: one solved scene; the result is NaN where it failed.

    **Returns:** shape (6, 6) [rad and m per N m and N]; symmetric if the loads have a potential.
    """
    return _compliance(eq)


@program("compliance")
def _compliance(eq: Equilibrium) -> Array:
    if eq.scene.coupled or not eq.model.balanced_everywhere:
        found = jax.jacfwd(lambda wrench: _motion(_pushed(eq, wrench).tip, eq.tip))(
            jnp.zeros(6, eq.inputs.dtype)
        )
        return eq.masked(found)
    nodes, free = eq.nodes, jnp.array(eq.scene.free)
    rows = tangent(nodes.xi, nodes.sections, nodes.tau(eq.sound_forces))
    H = c.join_matrix(c.symmetric(free_block(rows, eq.scene.free))).reshape(
        -1, free.size, free.size
    )
    poses = eq.pose(nodes.grid.X.reshape(-1))
    G = jax.vmap(lambda g: _carried(g, eq.tip))(poses)[:, free]
    weight = c.times(nodes.sections.flexible, nodes.grid.weight)
    weight = jnp.broadcast_to(weight, nodes.grid.X.shape).reshape(-1)
    found = jnp.einsum("x,xai,xaj->ij", weight, G, jnp.linalg.solve(H, G))
    return eq.masked(found)


def _pushed(eq: Equilibrium, wrench: Float[Array, "6"]) -> Equilibrium:
    """The equilibrium with an additional wrench on the tip."""
    loads = (*eq.scene.loads, TipWrench(wrench[3:], wrench[:3]))
    old = eq.scene
    around = {"held": old.held, "obstacles": old.obstacles}
    scene = Scene(old.rod, old.actuators, loads, free_strains=old.free_strains, **around)
    return _moved(eq, scene, eq.inputs)


def _moved(eq: Equilibrium, scene: Scene, inputs: Array) -> Equilibrium:
    """The equilibrium as a function of the numbers of its scene and of its inputs, to be
    differentiated: it is not solved again."""
    near = Near(eq.model, eq.scene, eq.sound_forces, eq.state)
    return Equilibrium(scene, inputs, eq.model, eq.model.solve_at(scene, inputs, near))


def _carried(g: Pose, tip: Pose) -> Float[Array, "6 6"]:
    """Matrix from a wrench on the tip, in the world's axes, to the wrench in a section's frame."""
    turned = g[:3, :3].T
    arm = tip[:3, 3] - g[:3, 3]
    moment = jnp.concatenate([turned, turned @ skew(arm)], axis=1)
    return jnp.concatenate([moment, jnp.concatenate([jnp.zeros_like(turned), turned], axis=1)])


class Ellipsoid(NamedTuple):
    """An ellipsoid in space: `centre` [m] and semi-`axes`, the columns of a matrix, longest
    first."""

    centre: Float[Array, "3"]
    axes: Float[Array, "3 3"]

    @property
    def measure(self) -> Array:
        """Product of the semi-axes; 0 for a flat ellipsoid."""
        return jnp.prod(c.norm(c.split(self.axes.T)))


def ellipsoid(matrix: Float[Array, "3 columns"], centre: Float[Array, "3"]) -> Ellipsoid:
    r"""The set $\{c + A x : |x| \le 1\}$ for a centre c."""
    U, lengths, _ = jnp.linalg.svd(matrix, full_matrices=False)
    return Ellipsoid(centre, jnp.zeros((3, 3), U.dtype).at[:, : lengths.size].set(U * lengths))


def manipulability(eq: Equilibrium, scale: VectorLike = 1.0) -> Ellipsoid:
    r"""Manipulability ellipsoid: displacements of the tip for changes of the inputs with $\sum_i
    (\delta u_i / s_i)^2 \le 1$.

    Its `measure` is Yoshikawa's, $\sqrt{\det J J^T}$ of the scaled J, 0 for fewer than three
    inputs.

    **Arguments:** `eq`: a solved scene; `scale`: $s$, one number or one per input, in the
    units of the inputs.

    **Source:** T. Yoshikawa, Manipulability of Robotic Mechanisms, Int. J. Robotics Research 4
    (1985).
    """
    return ellipsoid(tip_jacobian(eq)[3:] * jnp.asarray(scale, eq.inputs.dtype), eq.tip[:3, 3])


def compliance_ellipsoid(eq: Equilibrium, force: ScalarLike = 1.0) -> Ellipsoid:
    """Displacements of the tip for forces on it of at most `force` [N] in any direction."""
    return ellipsoid(compliance(eq)[3:, 3:] * force, eq.tip[:3, 3])

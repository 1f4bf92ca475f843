"""The equilibrium of an assembly."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..models.base import Model, Outcome, Status
from ..solution.equilibrium import Equilibrium
from ..typing import Scalar
from ..validation import is_traced
from .assembly import Assembly


class AssemblyEquilibrium(eqx.Module):
    r"""A solved assembly.

    **Fields:**
    - `poses` of the bodies, shape (bodies, 4, 4); NaN where the solve failed.
    - `arms`: the `Equilibrium` of each arm between its joints, with all its quantities: in
      `eq.arms[0].supports` are the wrenches of its own held sections and of its joints.
    - `stiffness`: K of the bodies, shape (6 bodies, 6 bodies), by turns [rad] about the axes of
      each and motions [m] along those of the world: [N m] and [N].
    - `stability`: the least eigenvalue of K, with turns in radians, motions as a share of the mean
      length of the arms, in units of the arms' mean bending stiffness over that length: positive
      where the whole is stable. Without bodies the least margin of the arms.
    - `status`, `steps`, `inputs`, `model` and `assembly`: as of an `Equilibrium`; `search`, from
      which another solve starts. A whole that nothing resists in some motion counts as unstable.

    `poses` and `arms` have derivatives; `stiffness` and `stability` are constants in them.
    """

    assembly: Assembly
    inputs: Float[Array, " inputs"]
    model: Model
    poses: Float[Array, "*batch bodies 4 4"]
    arms: tuple[Equilibrium, ...]
    stiffness: Array
    stability: Scalar
    status: Array
    steps: Array
    search: tuple[Outcome, ...] = eqx.field(repr=False)

    @property
    def converged(self) -> Array:
        """Whether a stable equilibrium was found."""
        return self.status == Status.CONVERGED

    @property
    def message(self) -> str:
        """Message of the status."""
        return Status(int(self.status)).message

    @property
    def energy(self) -> Scalar:
        """Potential energy [J] of the arms and of the weights and forces on the bodies, the latter
        as from the origin of the world."""
        total = sum((eq.energy.total for eq in self.arms), start=jnp.zeros(()))
        for body, pose in zip(self.assembly.bodies, self.poses, strict=True):
            total -= body.force @ pose[:3, 3]
            if body.mass is not None:
                place = pose[:3, 3] + pose[:3, :3] @ body.centre
                total -= body.mass * self.assembly.gravity @ place
        return total

    def __repr__(self) -> str:
        if is_traced(self.status) or jnp.ndim(self.status) > 0:
            return f"AssemblyEquilibrium(batch={jnp.shape(self.status)})"
        if not bool(self.converged):
            return f"AssemblyEquilibrium({self.message})"
        places = [", ".join(f"{x:.6g}" for x in pose[:3, 3]) for pose in np.asarray(self.poses)]
        bodies = "; ".join(f"({place}) m" for place in places)
        return f"AssemblyEquilibrium(converged in {int(self.steps)} steps, bodies at {bodies})"

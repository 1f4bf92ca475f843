"""The first task in SoRoMoX, see `first_task.py`. `# %%` starts a part.

SoRoMoX computes the forces and energies of an arm; the equilibrium is a root of the gradient of its
energy, found by the Newton method of optimistix, which also has its implicit derivative.
"""

# %% import
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optimistix  # pyright: ignore[reportMissingImports]
from soromox.actuation import ThreadlikeActuator, ThreadlikeRouting  # pyright: ignore[reportMissingImports]
from soromox.rendering import MatplotlibRenderer  # pyright: ignore[reportMissingImports]
from soromox.systems.components import JointSpec, LinkSpec  # pyright: ignore[reportMissingImports]
from soromox.systems.gvs import GVS, GVSSegment, StrainBasisSpec  # pyright: ignore[reportMissingImports]
from soromox.utils.geometry.poses import spatial_mounting_pose  # pyright: ignore[reportMissingImports]

jax.config.update("jax_enable_x64", True)

# %% arm
link = LinkSpec.circular(
    length=0.3,
    radius=0.0007,
    density=6450.0,
    reference_strain=[0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
    young_modulus=54e9,
    poisson_ratio=0.3,
)
basis = StrainBasisSpec(type="legendre", strain_selector=[1] * 6, basis_order=3)
segment = GVSSegment(link=link, joint=JointSpec(type="fixed"), basis=basis, num_gauss_points=8)
places = jnp.array([[0.0, 0.0, 0.010], [0.0, 0.00866, -0.005], [0.0, -0.00866, -0.005]])
force = jnp.array([0.0, 0.05, 0.0])


def tendons(places):
    return ThreadlikeActuator.tendons(ThreadlikeRouting.linear(intercept=places))


robot = GVS.from_segments(
    [segment],
    gravity=jnp.array([0.0, 0.0, -9.81]),
    base_pose=spatial_mounting_pose("horizontal"),
    actuators=tendons(places),
)


# %% solve
def position(q):
    return robot.forward_kinematics_tips(q)[-1, :3, 3]


def energy(q, numbers):
    places, tensions = numbers
    work = tensions @ tendons(places).coordinates(robot, q) + force @ position(q)
    return robot.potential_energy(q) - work


def solve(places, tensions):
    newton = optimistix.Newton(rtol=1e-8, atol=1e-8)
    rest = jnp.zeros(robot.num_coordinates)
    numbers = places, tensions
    return optimistix.root_find(jax.grad(energy), newton, rest, numbers, max_steps=50).value


inputs = jnp.array([2.0, 0.0, 0.5])
q = jax.jit(solve)(places, inputs)
tip = position(q)
print(tip)

# %% picture
plt.imsave("arm.png", MatplotlibRenderer(robot).render_frame(q, actuator_inputs=inputs))


# %% gradient
def height(places):
    return position(solve(places, inputs))[2]


slope = jax.jit(jax.grad(height))(places)[0, 2]
print(f"d tip_z / d distance of the first tendon: {slope:.4f}")

# %% workspace
tensions = np.random.default_rng(0).uniform(0.0, 4.0, (10_000, 3))
reach = jax.jit(lambda tensions: position(solve(places, tensions)))
tips = jax.lax.map(reach, jnp.asarray(tensions), batch_size=500)
print(tips.min(axis=0), tips.max(axis=0))

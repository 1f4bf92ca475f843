"""The first task in vsr_jax, see `first_task.py`. `# %%` starts a part."""

# %% import
import jax
import matplotlib.pyplot as plt
import numpy as np

import vsr_jax as vsr

jax.config.update("jax_enable_x64", True)

# %% arm
wire = vsr.Rod(
    length=0.3,
    section=vsr.Circular(radius=0.0007),
    material=vsr.Material(young=54e9, poisson=0.3, density=6450.0),
    discs=vsr.Discs(10, radius=0.0101),
)
places = [(0.0, 0.010), (0.00866, -0.005), (-0.00866, -0.005)]
tendons = [vsr.Tendon(vsr.Parallel(y, z)) for y, z in places]
loads = [vsr.Gravity(), vsr.TipWrench(force=(0.0, 0.05, 0.0))]
scene = vsr.Scene(wire, tendons, loads)
model = vsr.StrainDependent(steps=6)

# %% solve
eq = vsr.solve(scene, [2.0, 0.0, 0.5], model=model)
tip = eq.tip[:3, 3]
print(eq)

# %% picture
vsr.plot.arm(eq)
plt.savefig("arm.png")


# %% gradient
def height(scene):
    return vsr.solve(scene, [2.0, 0.0, 0.5], model=model).tip[2, 3]


slope = jax.grad(height)(scene).actuators[0].routing.z
print(f"d tip_z / d distance of the first tendon: {slope:.4f}")

# %% workspace
tensions = np.random.default_rng(0).uniform(0.0, 4.0, (10_000, 3))
result = vsr.sweep(scene, tensions, model=model)
tips = result["tip"][:, :3, 3]
print(result)

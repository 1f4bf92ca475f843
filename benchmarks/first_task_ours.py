"""The first task in vsr_jax, see `first_task.py`: a catheter, its picture, a gradient, a workspace.

Marks `# part` start a part: `first_task.py` counts the lines and the seconds of each.
"""

# part: import
import sys

import jax
import jax.numpy as jnp
import matplotlib
from first_task import Parts

import vsr_jax as vsr

parts = Parts()
matplotlib.use("Agg")
jax.config.update("jax_enable_x64", True)

# part: arm
wire = vsr.Rod(
    length=0.3,
    section=vsr.Circular(0.0007),
    material=vsr.Material(young=54e9, poisson=0.3, density=6450.0),
    guide_radius=0.0101,
)
tendons = [
    vsr.Tendon(vsr.Parallel(y, z))
    for y, z in ((0.0, 0.01), (0.00866, -0.005), (-0.00866, -0.005))
]
loads = [vsr.Gravity(), vsr.TipWrench(force=(0.0, 0.05, 0.0))]
scene = vsr.Scene(wire, tendons, loads)

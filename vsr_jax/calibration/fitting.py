r"""Calibration: numbers of a scene, and of the rig that measured it, from measured shapes.

$\min_\theta \frac12 \sum_i \rho\!\left( \left( \frac{h_i(\theta) - y_i}{\sigma_i} \right)^2 \right)
+ \frac12 \sum_k \left( \frac{\theta_k - m_k}{s_k} \right)^2, \quad l_k \le \theta_k \le h_k$

for measured numbers $y_i$ with standard deviations $\sigma_i$, what the model predicts for them,
$h_i$, and priors $m_k \pm s_k$. The derivatives of $h_i$ are the implicit derivatives of the
equilibria.
"""

import numpy as np
from tqdm import tqdm

from ..arm.scene import Scene
from ..models.base import Model
from ..numerics.compiling import messages
from ..validation import choice, count, instance
from .assignment import adjusted
from .least_squares import LOSSES
from .measurements import Measurements
from .problem import Adjusted, FitProblem, formulate
from .result import Fit
from .unknowns import Free


def fit(
    scene: Scene,
    free: Free,
    data: Measurements,
    *,
    model: Model | None = None,
    loss: str = "linear",
    starts: int = 1,
    steps: int = 100,
    seed: int = 0,
    progress: bool = True,
) -> Fit:
    """Numbers of a scene, and of the rig that measured it, for which the model agrees best with
    measured shapes, and how sure they are.

        data = vsr.Measurements(tensions, vsr.Markers(positions, X=[0.1, 0.2], sd=2e-4))
        free = {
            "rod.material.young": vsr.Unknown(1e5, 1e6, prior=(5e5, 1e5)),
            "actuators[*].friction": vsr.Unknown(0.0, 0.4, shared=True),
            "base.position": (-0.005, 0.005),
            "inputs.gain": (0.7, 1.3),
        }
        found = vsr.fit(scene, free, data)
        print(found)
        vsr.save(found.scene, "calibrated.toml")

    **Arguments:**
    - `scene`: its numbers are the first start.
    - `free`: the unknowns by name, each an `Unknown` or a pair of bounds, `[*]` for every index:
      numbers of the scene, see `vsr_jax.parameters`; `base.position[A]` [m] and `base.rotation[A]`
      [rad], displacement and rotation vector of the base in the world's axes for the series A
      (without brackets if there is one series without a name); `inputs.gain` and `inputs.offset`,
      one number per actuator, for inputs g u + o of recorded u; `markers.offset` and other numbers
      of an observation by its name.
    - `data`: what was measured. The dtype of its inputs is the precision of the solves.
    - `model`: as for `solve`.
    - `loss`: `"linear"`, the sum of squares; `"huber"` or `"cauchy"` give outliers less weight.
    - `starts`: number of starts; all but the first are drawn between the bounds with `seed`.
    - `steps`: most steps of one minimisation.
    - `progress`: whether to show a progress bar.

    Shapes without an equilibrium, or at which a measured number has no derivatives, do not count:
    they are named in the result and tried again at every step; no step gives up a shape that
    counts. Where an observation has no `sd`, it is estimated from the residuals, so
    that $\\chi^2$ equals the degrees of freedom.

    **Returns:** a `Fit`.

    **Raises:** `ValueError` for unknown names, contradictory bounds, priors without a positive
    standard deviation, more unknowns than measured numbers and priors, inputs out of range, markers
    that the arm cannot reach (millimetres are named as such), and if no shape has an equilibrium.
    """
    instance("scene", scene, Scene, "a Scene")
    instance("data", data, Measurements, "Measurements")
    choice("loss", loss, LOSSES)
    if model is not None:
        instance("model", model, Model, "StrainDependent(), Prescribed(basis) or Continuum()")
    number = count("starts", starts)
    problem = formulate(scene, free, data, model, loss, count("steps", steps))
    return _best(problem, _starts(problem, number, seed), progress)


def _starts(problem: FitProblem, number: int, seed: int) -> list[np.ndarray]:
    draw = np.random.default_rng(seed).uniform(size=(number - 1, len(problem.columns)))
    box = problem.box
    return [problem.start, *(box.low + (box.high - box.low) * draw)]


def _best(problem: FitProblem, starts: list[np.ndarray], progress: bool) -> Fit:
    found: list[tuple[FitProblem, Adjusted]] = []
    with tqdm(unit=" steps", disable=not progress, desc="compiling") as bar, messages(False):

        def report(step: int, cost: float) -> None:
            bar.set_description("")
            bar.set_postfix_str(f"start {len(found) + 1} of {len(starts)}, cost {cost:.4g}")
            bar.update()

        sd = None
        for start in starts:
            found.append(adjusted(problem, start, sd=sd, report=report))
            # costs compare for the same standard deviations only
            sd = found[-1][1].sd if sd is None else sd
    minima = [one.minimum for _, one in found]
    solved = [int(np.sum(one.residuals.solved)) for one in minima]
    if not max(solved):
        raise ValueError(
            f"fit: got no equilibrium for any of the {len(problem.data)} shapes, need bounds and a "
            f"scene that can be solved for these inputs"
        )
    best = min(range(len(found)), key=lambda i: (-solved[i], minima[i].cost))
    chosen = found[best] if best == 0 else adjusted(found[best][0], minima[best].x)
    return Fit(*chosen, tuple(one.cost for one in minima))

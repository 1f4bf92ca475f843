"""How the sections of an arm act on each other."""

from typing import NamedTuple

from jaxtyping import Array

from .spans import Spans


class Coupled(NamedTuple):
    r"""How the sections of a chain act on each other, in the world's axes, arrays (..., stages,
    steps, *arms). A motion of a section is its rotation $\theta$ or, where something depends on
    positions, $(\theta, \rho)$ with its displacement.

    - `rotation` (3, 3), `axis` $u = p'$ (3), `wrench` $(m, n)$ (6) and its density along the arm,
      $(c + u \times n, f)$ (6), at the nodes.
    - `density` (6, motion): derivative of the loads (c, f) by the motion of the section; `ends` (6,
      motion, steps, *arms): of loads at the ends of the steps; `cells` (6, 6): of what acts in the
      cells of the nodes, about these, behind a `part` of each cell. None where nothing changes.
    - `spans`: springs across spans of the chain, about the sections at their ends; None without.
    """

    rotation: Array
    axis: Array
    wrench: Array
    wrench_density: Array
    density: Array | None = None
    ends: Array | None = None
    cells: Array | None = None
    part: Array | None = None
    spans: Spans | None = None

    @property
    def motion(self) -> int:
        """Size of the motions: 0 if all loads are dead, 3 or 6."""
        if self.spans is not None:
            return 6
        matrices = [x for x in (self.density, self.ends, self.cells) if x is not None]
        return matrices[0].shape[1] if matrices else 0

"""Cost of each effect of a scene: operations, compile time, and the times of a solve, single and in
a batch of 1,024.

    python benchmarks/bench_effects.py [--json FILE] [--rounds N]

One arm with two tendons to which effects are added one after another, then others one by one to the
arm under gravity (`vsr_jax.studies.effects`), float64, all solves timed in turn in one run.
`vsr-jax effects` prints the same table for a smaller batch.
"""

import argparse
import json
from pathlib import Path

import jax

from vsr_jax.studies import effects
from vsr_jax.studies.timing import machine

BATCH = 1024


def main() -> None:
    """Run the benchmark and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="also write the results to this file")
    parser.add_argument("--rounds", type=int, default=15, help="timings per solve (15)")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(
        f"{machine()}, jax {jax.__version__}; 16 steps of order 6, {BATCH} in a batch; median (10 "
        f"%-90 %), x: relative to the row above, or to that in brackets"
    )
    costs = effects.measure(BATCH, options.rounds)
    print("\n".join(effects.table(costs)))
    if options.json:
        report = {
            "machine": machine(),
            "jax": jax.__version__,
            "rows": [cost._asdict() for cost in costs],
        }
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""XLA's flags in the tests. XLA ends the process at a flag that it does not know: all but the first
are for versions that were tried."""

import jax

PASSES = (
    "simplify-while-loops,while-loop-invariant-code-motion,while-loop-constant-sinking,"
    "reshape-mover,simplify-conditional"
)
"""Without these XLA takes a quarter less of what remains."""

FLAGS = [
    "--xla_backend_optimization_level=0",
    "--xla_cpu_parallel_codegen_split_count=1" * (jax.__version_info__ < (0, 13)),
    f"--xla_disable_hlo_passes={PASSES}" * (jax.__version_info__ < (0, 13)),
    "--xla_cpu_use_fusion_emitters=false" * (jax.__version_info__ < (0, 11)),
]

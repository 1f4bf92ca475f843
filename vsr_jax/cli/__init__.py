"""The command line: `vsr-jax`, one module for each group of commands."""

"""Compiled functions that count how often they were traced."""

import jax


class Counted:
    """`jax.jit(function)`; `traces` is the number of programs that it had to make.

    JAX's own counter of a function's programs is that of a cache of limited size: it says 0 in a long run.
    """

    def __init__(self, function, **options):
        self.traces = 0

        def traced(*arguments):
            self.traces += 1
            return function(*arguments)

        self._compiled = jax.jit(traced, **options)

    def __call__(self, *arguments):
        return self._compiled(*arguments)

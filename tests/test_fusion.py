"""Borders of fusion: the function that they enclose, its derivatives, and what they keep for reverse mode."""

import jax
import jax.numpy as jnp
import numpy as np

from shapeenh.fusion import stored, unknown_truth


def plain(always, function, *args):
    return function(*args)


def staged(border, x, y, k):
    """A program of two stages; one closes over a traced array and returns what has no derivative, too."""
    always = unknown_truth(x, y)
    z = jnp.sin(x) * y
    u, number, positive = border(always, lambda x, k: (x * z * k, k * k, x > 1), x, k)
    v = border(always, lambda pair, count: jnp.where(pair[1], pair[0] ** 2, 0) + count, (u, positive), jnp.arange(4))
    return jnp.sum(v * y) + number


def arguments():
    return jnp.arange(4.0) + 0.3, jnp.arange(4.0) - 0.4, jnp.asarray(2.0)


def conditionals(program):
    """Of a program and all that it calls, in order."""
    for equation in program.eqns:
        if equation.primitive.name == "cond":
            yield equation
            continue
        for inner in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda p: hasattr(p, "eqns")):
            if hasattr(inner, "eqns"):
                yield from conditionals(inner)


def test_derivatives_are_those_of_the_function(x64):
    for by in (0, 1, 2, (0, 1, 2)):
        wanted = jax.grad(lambda *a: staged(plain, *a), by)(*arguments())
        for transform in (lambda f: f, jax.jit):
            got = jax.grad(transform(lambda *a: staged(stored, *a)), by)(*arguments())
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), got, wanted)


def test_second_derivatives_and_batches(x64):
    def turned(border):
        slope = lambda *a: jnp.sum(jnp.cos(jax.grad(staged, 1)(border, *a)))  # noqa: E731
        batch = [jnp.stack([a, 1.5 * a]) for a in arguments()]
        return jax.jit(jax.grad(slope, (0, 1, 2)))(*arguments()), jax.vmap(jax.grad(slope))(*batch)

    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9), turned(stored), turned(plain))


def test_nothing_but_results_is_handed_on():
    """A derivative taken through a conditional would hand on all arguments as copies."""
    program = jax.make_jaxpr(jax.grad(lambda *a: staged(stored, *a), (0, 1)))(*arguments())
    forward = list(conditionals(program))[:2]
    assert [len(e.outvars) for e in forward] == [3, 1]


def test_borders_outlast_batches():
    """Under `vmap` a conditional on a batch of predicates becomes a selection, which is no border."""
    batch = [jnp.stack([a, 1.5 * a]) for a in arguments()]
    program = jax.make_jaxpr(jax.vmap(lambda *a: staged(stored, *a)))(*batch)
    assert len(list(conditionals(program))) == 2

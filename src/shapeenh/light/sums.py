"""The sum over lights of every covered pixel, and its adjoint (SPEC 5 and 6: the reflection integrals, sampled).

`shade_image` walks the covered blocks in groups. Per group a *prologue* turns the pixels' inputs into the planes that
the weights need, the light loop adds up weight times colour, and an *epilogue* makes radiance of the sums. Per block
only the lights that its normals can see are visited: those for which the largest n.l over the box of its normals is
positive.

The adjoint is a second walk: prologue and epilogue are differentiated by JAX, the light loop by hand: a pixel's
cotangent is known once its sum is, so one more visit of its lights gives everything. The sums are taken once more
there: to keep them takes as long, for the memory alone. It needs none that depends on the number of lights.

Measured on CPU: three sums kept apart take a tenth of the time of one stacked array, because XLA computes a fused
producer again for every output; `stored` keeps the weights from being fused into the sums for the same reason.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.fusion import stored, unknown_truth
from shapeenh.light import blocks
from shapeenh.light import weights as kernel

SPAN = 128  # lights whose visibility is decided at a time


class Plan(NamedTuple):
    """What is summed; static. Inputs are dicts of planes, (block, channel, 64), by name.

    prologue: model, inputs, predicate for `stored` -> (planes of `kernel.planes_of(model)`, each (block, 64), rest),
    rest any pytree of arrays.
    epilogue: (sums, rest) -> (block, 3, 64); sums are the components' (block, 3, 64); linear in them.
    reach: which planes each input moves, so that derivatives nobody asks for are not computed.
    group, chunk: blocks per step and lights per step.
    """

    model: kernel.Model
    prologue: Callable
    epilogue: Callable
    reach: tuple[tuple[str, tuple[str, ...]], ...]
    group: int = 256
    chunk: int = 8


# ------------------------------------------------------------------------------------------- lights


def ladder(count: int, chunk: int) -> int:
    """Rows to which a table of lights is padded: few sizes, so that few shapes are compiled."""
    size = chunk
    while size < count:
        size *= 2
    return size


def _light_table(direction, radiance, rows: int):
    """[rows + 1, 9 + 3] coefficients and colours; what lies beyond the given lights is dark."""
    table = jnp.concatenate([kernel.coefficients(direction), radiance], axis=-1)
    dark = jnp.asarray([[1, 0, 0, 1, 0, 0, 0, 2, 1, 0, 0, 0]], table.dtype)
    return jnp.concatenate([table, jnp.broadcast_to(dark, (rows + 1 - table.shape[0], dark.shape[1]))])


def _seen(box, table, first, size: int, count):
    """[size, boxes]: which of the lights from `first` on can light some normal of the boxes low, high [3, boxes]."""
    low, high = box
    part = lax.dynamic_slice_in_dim(table, first, size)[:, :, None]
    most = sum(jnp.maximum(part[:, 1 + k] * low[None, k], part[:, 1 + k] * high[None, k]) for k in range(3))
    return (most > 0) & (first + lax.iota(jnp.int32, size) < count)[:, None]


def _compact(active, first, dark):
    """Numbers of the active lights of each block, [blocks, lights], first ones first, then `dark`; and how many."""
    lights, count = active.shape
    # A triangular product counts faster than a cumulative sum.
    until = jnp.dot(
        np.tril(np.ones((lights, lights), np.float32)), active.astype(jnp.float32), precision=lax.Precision.HIGHEST
    ).astype(jnp.int32)
    number, block = (lax.broadcasted_iota(jnp.int32, active.shape, axis) for axis in (0, 1))
    lists = jnp.full((count, lights + 1), dark, jnp.int32)
    lists = lists.at[block, jnp.where(active, until - 1, lights)].set(first + number, mode="promise_in_bounds")
    return lists[:, :lights], until[-1]


def _light_loop(plan: Plan, box, table, count, body, carry):
    """`body(carry, numbers, rows)` over chunks of lights that the blocks see: (block, chunk), (block, chunk, 12)."""
    rows = table.shape[0] - 1
    span = min(rows, SPAN)

    def over_span(i, carry):
        lists, lengths = _compact(_seen(box, table, i * span, span, count), i * span, rows)

        def over_chunk(j, carry):
            numbers = lax.dynamic_slice_in_dim(lists, j * plan.chunk, plan.chunk, axis=1)
            return body(carry, numbers, table.at[numbers].get(mode="promise_in_bounds"))

        return lax.fori_loop(0, -(-jnp.max(lengths) // plan.chunk), over_chunk, carry)

    return lax.fori_loop(0, -(-count // span), over_span, carry)


def _unpack(rows):
    """Coefficients by name, (block, light, 1), and colours (block, light, 3)."""
    light = {name: rows[:, :, i, None] for i, name in enumerate(kernel.COEFFICIENTS)}
    return light, rows[:, :, len(kernel.COEFFICIENTS) :]


def _forms(model: kernel.Model, planes, light):
    """The forms, and whether the (warped) light itself is in front of the surface; planes (block, plane, 64)."""
    plane = {name: planes[:, None, i] for i, name in enumerate(kernel.planes_of(model))}
    form = kernel.forms(model, plane, light)
    if model.warped:
        form["facing"] = plane["nx"] * light["x"] + plane["ny"] * light["y"] + plane["nz"] * light["z"]
    return form


def _weights(model: kernel.Model, on, planes, rows, derivatives: bool):
    """(What the weights and their derivatives have in common, the weights), each (block, light, 64) and stored; with
    `derivatives` all that these need of it.

    What they have in common apart: a root, a cosine and a logarithm once instead of in every kernel that needs them,
    and kernels that keep fewer values alive, take a fifth less time.
    """

    def made(function, known):
        def of(planes, rows, known):
            light, _ = _unpack(rows)
            return function(_forms(model, planes, light) | known, light)

        return stored(on, of, planes, rows, known)

    known: dict = {}
    if model.warped:
        known = {"root": made(kernel.root, known)}
        known = known | {"cos_light": made(kernel.warped_cosine, known)}
    if model.glossy:
        log = lambda form, light: kernel.logarithm(kernel.meet(model, form, light).cos_half)  # noqa: E731
        known = known | {"log": made(log, known)}
    if model.anisotropic:
        known = known | {"curvature": made(functools.partial(kernel.curvature, model), known)}
        for lobe in kernel.lobes(model):
            known = known | {f"gain_{lobe}": made(functools.partial(kernel.anisotropic_gain, lobe), known)}
    known = known | {"diffuse": made(functools.partial(kernel.diffuse, model), known)}
    if not model.glossy:
        return known, (known["diffuse"],)
    if not model.tinted and not derivatives:
        return known, (known["diffuse"], made(functools.partial(kernel.reflected_at_once, model), known))
    known = known | {"specular": made(functools.partial(kernel.specular, model), known)}
    last = made(functools.partial(kernel.reflected, model), known)
    return known, (known["diffuse"], known["specular"], last) if model.tinted else (known["diffuse"], last)


def _add_weighted(total, weight, colour):
    """total (block, channel, 64) + sum over lights of weight (block, light, 64) colour (block, light, channel)."""
    return total + sum(weight[:, b, None, :] * colour[:, b, :, None] for b in range(weight.shape[1]))


# ------------------------------------------------------------------------------------------- the walk


class _Walk(NamedTuple):
    """The covered blocks in the order of their work, padded by repeating the last, and the boxes of their normals."""

    ids: jax.Array
    total: jax.Array
    low: jax.Array
    high: jax.Array


def _group(plan: Plan, mask) -> int:
    """Blocks per step, of a padded mask."""
    return min(plan.group, mask.size // blocks.PIXELS)


def _plan_walk(plan: Plan, mask, normal, table, count) -> _Walk:
    covered = blocks.covered(mask)
    group = _group(plan, mask)
    ids, total = blocks.listed(jnp.zeros(covered.shape, jnp.int32), covered, group)
    size = min(4 * group, ids.shape[0])

    def box(i, found):
        part = lax.dynamic_slice_in_dim(ids, i * size, size)
        n, valid = blocks.read(normal, part), blocks.read(mask, part)
        n = jnp.concatenate([n[:, :2], jnp.abs(n[:, 2:])], axis=1)  # as the prologue shades it
        valid = valid & (jnp.abs(n) <= 2)
        ends = blocks.least(jnp.where(valid, n, 2)), -blocks.least(jnp.where(valid, -n, 2))
        return tuple(
            lax.dynamic_update_slice_in_dim(a, new.T, i * size, axis=1) for a, new in zip(found, ends, strict=True)
        )

    empty = jnp.zeros((3, ids.shape[0]), normal.dtype)
    low, high = lax.fori_loop(0, -(-total // size), box, (empty, empty))

    def count_lights(i, work):
        return work + sum(_seen((low, high), table, i * plan.chunk, plan.chunk, count).astype(jnp.int32))

    work = lax.fori_loop(0, -(-count // plan.chunk), count_lights, jnp.zeros(ids.shape, jnp.int32))
    order, _ = blocks.listed(work, lax.iota(jnp.int32, ids.shape[0]) < total, group)
    return _Walk(ids[order], total, low[:, order], high[:, order])


def _read_inputs(inputs, mask, ids, spread: bool):
    """Planes of every input at the pixels of some blocks, and where they are valid; elsewhere 0, and n = z.

    Constants are (1, channel, 1), or with `spread` planes as well.
    """
    found = {name: blocks.read(v, ids) if v.ndim >= 2 else v[None, :, None] for name, v in inputs.items()}
    valid = blocks.read(mask, ids)
    for value in found.values():
        valid = valid & jnp.all(jnp.isfinite(value), axis=1, keepdims=True)
    for name, value in found.items():
        there = valid if spread or inputs[name].ndim >= 2 else jnp.isfinite(value)
        found[name] = jnp.where(there, value, 0)
    z = jnp.where(valid, found["normal"][:, 2:], 1)
    found["normal"] = jnp.concatenate([found["normal"][:, :2], z], axis=1)
    return found, valid


def _plane_array(plan: Plan, on, inputs):
    planes, rest = plan.prologue(plan.model, inputs, on)
    whole = planes["nx"].shape
    return jnp.stack([jnp.broadcast_to(planes[name], whole) for name in kernel.planes_of(plan.model)], axis=1), rest


def _forward(plan: Plan, mask, inputs, direction, radiance, count):
    """The image, and the walk."""
    height, width = mask.shape
    mask, inputs = blocks.padded(mask), {k: blocks.padded(v) if v.ndim >= 2 else v for k, v in inputs.items()}
    table = _light_table(direction, radiance, ladder(direction.shape[0], plan.chunk))
    walk, group = _plan_walk(plan, mask, inputs["normal"], table, count), _group(plan, mask)
    on = unknown_truth(*inputs.values(), direction, radiance)

    def step(i, image):
        ids = lax.dynamic_slice_in_dim(walk.ids, i * group, group)
        found, valid = stored(on, lambda ids: _read_inputs(inputs, mask, ids, spread=False), ids)
        planes, rest = stored(on, lambda found: _plane_array(plan, on, found), found)

        def body(sums, numbers, rows):
            _, colour = _unpack(rows)
            _, weight = _weights(plan.model, on, planes, rows, derivatives=False)
            return tuple(_add_weighted(*pair, colour) for pair in zip(sums, weight, strict=True))

        zero = jnp.zeros((group, 3, blocks.PIXELS), planes.dtype)
        box = tuple(lax.dynamic_slice_in_dim(a, i * group, group, axis=1) for a in (walk.low, walk.high))
        sums = _light_loop(plan, box, table, count, body, (zero,) * plan.model.components)
        return blocks.write(image, ids, stored(on, lambda *a: jnp.where(valid, plan.epilogue(*a), 0), sums, rest))

    image = jnp.zeros((*mask.shape, 3), radiance.dtype)
    image = lax.fori_loop(0, -(-walk.total // group), step, image)
    return image[:height, :width], walk


# ------------------------------------------------------------------------------------------- the adjoint


def _products(weights, cotangents):
    """Sums over pixels of weight (block, light, 64) cotangent (block, 3, 64), as (block, light, 3, 8), the last axis
    still to be added up: eight lanes at a time, because a sum along the axis that is vectorised is not."""
    total = 0
    for k in range(0, blocks.PIXELS, blocks.SIDE):
        part = slice(k, k + blocks.SIDE)
        total = total + sum(
            w[:, :, None, part] * bar[:, None, :, part] for w, bar in zip(weights, cotangents, strict=True)
        )
    return total


def _adjoint(plan: Plan, wanted: frozenset, mask, inputs, direction, radiance, count, walk, cotangent):
    """Cotangents of the inputs in `wanted`, of "direction" and of "radiance", given that of the image; `walk` as
    `_forward` returns it."""
    height, width = mask.shape
    shapes = {name: value.shape for name, value in inputs.items()}
    mask, cotangent = blocks.padded(mask), blocks.padded(cotangent)
    inputs = {k: blocks.padded(v) if v.ndim >= 2 else v for k, v in inputs.items()}
    table = _light_table(direction, radiance, ladder(direction.shape[0], plan.chunk))
    group = _group(plan, mask)
    on = unknown_truth(*inputs.values(), direction, radiance)
    # for the borders that follow one on `on`: see `stored`
    then = unknown_truth(*inputs.values(), direction, radiance, cotangent)
    lane = lax.iota(jnp.int32, group)
    moved = {plane for name, reached in plan.reach if name in wanted for plane in reached}
    names = kernel.planes_of(plan.model)
    pairs = kernel.terms(plan.model)
    reached = {form: [pair for pair in of_form if pair[0] in moved] for form, of_form in pairs.items()}
    reached = {form: of_form for form, of_form in reached.items() if of_form}
    used = [form for form in pairs if "direction" in wanted or form in reached]
    width_of = len(kernel.COEFFICIENTS)

    def step(i, found):
        images, constants, light_bar = found
        ids = lax.dynamic_slice_in_dim(walk.ids, i * group, group)
        pixels, valid = stored(on, lambda ids: _read_inputs(inputs, mask, ids, spread=True), ids)
        # The list's padding repeats a block, whose cotangent counts once.
        fresh = i * group + lane < walk.total
        given = jnp.where(valid & fresh[:, None, None], blocks.read(cotangent, ids), 0)
        planes, rest = stored(on, lambda pixels: _plane_array(plan, on, pixels), pixels)
        zero = jnp.zeros((group, 3, blocks.PIXELS), planes.dtype)
        sums = (zero,) * plan.model.components
        # The epilogue is linear in the sums, so their cotangents do not depend on them.
        pull_sums = jax.vjp(lambda *sums: plan.epilogue(sums, rest), *sums)[1]
        sums_bar = stored(on, lambda given: pull_sums(given), given)

        def body(carry, numbers, rows):
            sums, planes_bar, light_bar = carry
            known, weight = _weights(plan.model, on, planes, rows, derivatives=True)

            def derivatives(planes, rows, known):
                light, colour = _unpack(rows)
                form = _forms(plan.model, planes, light) | known
                along = tuple(sum(bar[:, None, c] * colour[:, :, c, None] for c in range(3)) for bar in sums_bar)
                bar, w_bar = kernel.adjoint(plan.model, form, light, along)
                return {name: bar[name] for name in used}, w_bar

            light, colour = _unpack(rows)
            if used:
                forms_bar, w_bar = stored(on, derivatives, planes, rows, known)
                # The planes of a form together: one kernel, and one that is large enough for XLA to share among cores.
                for form, of_form in reached.items():
                    factors = jnp.stack([light[coefficient][..., 0] for _, coefficient in of_form], axis=-1)
                    planes_bar = planes_bar | {form: _add_weighted(planes_bar[form], forms_bar[form], factors)}
            if images or constants:
                sums = tuple(_add_weighted(*pair, colour) for pair in zip(sums, weight, strict=True))
            light_bar = dict(light_bar)
            if "radiance" in wanted:
                lanes = stored(then, _products, weight, sums_bar)
                colour_bar = stored(on, lambda lanes: sum(lanes[..., i] for i in range(blocks.SIDE)), lanes)
                light_bar["radiance"] = light_bar["radiance"].at[numbers].add(colour_bar, mode="promise_in_bounds")
            if "direction" in wanted:
                columns = {name: jnp.zeros(numbers.shape, planes.dtype) for name in kernel.COEFFICIENTS}
                columns["w"] = blocks.sum_pixels(w_bar)
                for form in used:
                    for plane, coefficient in pairs[form]:
                        if coefficient != "one":
                            of_plane = planes[:, None, names.index(plane)]
                            columns[coefficient] += blocks.sum_pixels(forms_bar[form] * of_plane)
                table_bar = jnp.stack([columns[name] for name in kernel.COEFFICIENTS], axis=-1)
                light_bar["direction"] = light_bar["direction"].at[numbers].add(table_bar, mode="promise_in_bounds")
            return sums, planes_bar, light_bar

        planes_bar = {form: jnp.zeros_like(zero, shape=(group, len(k), blocks.PIXELS)) for form, k in reached.items()}
        box = tuple(lax.dynamic_slice_in_dim(a, i * group, group, axis=1) for a in (walk.low, walk.high))
        sums, planes_bar, light_bar = _light_loop(plan, box, table, count, body, (sums, planes_bar, light_bar))

        def finish(pixels, planes_bar, sums, given):
            by_plane: dict = {}
            for form, of_form in reached.items():
                for k, (plane, _) in enumerate(of_form):
                    by_plane[plane] = by_plane.get(plane, 0) + planes_bar[form][:, k]
            moving = {name: pixels[name] for name in images.keys() | constants.keys()}
            (planes, rest), pull = jax.vjp(lambda moving: plan.prologue(plan.model, pixels | moving, on), moving)
            rest_bar = jax.vjp(lambda rest: plan.epilogue(sums, rest), rest)[1](given)[0]
            planes_bar = {name: by_plane.get(name, jnp.zeros_like(value)) for name, value in planes.items()}
            return {name: jnp.where(valid, bar, 0) for name, bar in pull((planes_bar, rest_bar))[0].items()}

        bars = stored(on, finish, pixels, planes_bar, sums, given)
        once = jnp.where(fresh, ids, blocks.beyond(mask))
        images = {name: blocks.write(image, once, bars[name]) for name, image in images.items()}
        constants = {name: value + jnp.sum(bars[name], axis=0) for name, value in constants.items()}
        return images, constants, light_bar

    dtype = radiance.dtype
    images = {n: jnp.zeros((*mask.shape, *shapes[n][2:]), dtype) for n in wanted if len(shapes.get(n, ())) >= 2}
    constants = {n: jnp.zeros((shapes[n][0], blocks.PIXELS), dtype) for n in wanted if len(shapes.get(n, ())) == 1}
    lights_bar = {
        n: jnp.zeros((table.shape[0], k), dtype) for n, k in (("radiance", 3), ("direction", width_of)) if n in wanted
    }
    images, constants, lights_bar = lax.fori_loop(0, -(-walk.total // group), step, (images, constants, lights_bar))
    bars = {name: image[:height, :width] for name, image in images.items()}
    bars |= {name: jnp.sum(value, axis=1) for name, value in constants.items()}
    if "radiance" in wanted:
        bars["radiance"] = lights_bar["radiance"][: len(radiance)]
    if "direction" in wanted:
        pull = jax.vjp(kernel.coefficients, direction)[1]
        bars["direction"] = pull(lights_bar["direction"][: len(direction)])[0]
    return bars


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def shade_image(plan: Plan, mask, inputs, direction, radiance, count):
    """The sum over lights at every pixel of the mask, [H, W, 3]; 0 elsewhere and where an input is not finite.

    mask: [H, W] bool. inputs: dict of images [H, W, C] and of constants [C]; "normal" is one of them. direction,
    radiance: [N, 3]; of the N lights the first `count` shine.
    Gradient: in inputs, direction, radiance; what is not perturbed is not computed.
    """
    return _forward(plan, mask, inputs, direction, radiance, count)[0]


def _shade_image_forward(plan, mask, inputs, direction, radiance, count):
    perturbed = [n for n, v in (inputs | {"direction": direction, "radiance": radiance}).items() if v.perturbed]
    mask, inputs, direction, radiance, count = jax.tree.map(
        lambda leaf: leaf.value, (mask, inputs, direction, radiance, count)
    )
    image, walk = _forward(plan, mask, inputs, direction, radiance, count)
    return image, (mask, inputs, direction, radiance, count, {name: None for name in perturbed}, walk)


def _shade_image_backward(plan, saved, cotangent):
    mask, inputs, direction, radiance, count, perturbed, walk = saved
    nothing = (None, {name: None for name in inputs}, None, None, None)
    if isinstance(cotangent, jax.custom_derivatives.SymbolicZero) or not perturbed:
        return nothing
    bars = _adjoint(plan, frozenset(perturbed), mask, inputs, direction, radiance, count, walk, cotangent)
    inputs_bar = {name: bars.get(name) for name in inputs}
    return None, inputs_bar, bars.get("direction"), bars.get("radiance"), None


shade_image.defvjp(_shade_image_forward, _shade_image_backward, symbolic_zeros=True)

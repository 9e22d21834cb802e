"""Implicit brushes: the sum against its definition, weights, footprints, compression, noise, gradients, errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se
from shapeenh.lines.noise import CHANNELS
from shapeenh.types import GBuffer, LineField, Profile, replace

SIZE = 40
ROW, COL = np.mgrid[0:SIZE, 0:SIZE].astype(float)
X, Y = COL - SIZE / 2 + 0.5, SIZE / 2 - 0.5 - ROW


def straight(angle=0.0, offset=0.0, height=1.0, curvature=-0.1, dtype=np.float32):
    """The profile of a straight skeleton along the direction `angle`, known within 4 px of it."""
    theta = np.array([-np.sin(angle), np.cos(angle)])
    distance = offset - (theta[0] * X + theta[1] * Y)
    valid = np.abs(distance) <= 4
    planes = [np.where(valid, a, 0) for a in (distance, np.broadcast_to(height, X.shape), np.full_like(X, curvature))]
    field = LineField(
        jnp.zeros(X.shape, dtype), jnp.asarray(np.broadcast_to(theta, (*X.shape, 2)), dtype), jnp.zeros(X.shape, dtype)
    )
    return Profile(*(jnp.asarray(p, dtype) for p in planes), jnp.asarray(valid)), field


def noise_image(value=0.5, dtype=np.float32):
    return jnp.full((SIZE, SIZE, CHANNELS), value, dtype)


def definition(profile, field, brush, footprint):
    """I(y) = sum_x w(x) f(T_x(y - x)), one stamp after another, and its compression (eqs. 8.1 to 8.3)."""
    total = np.zeros((SIZE, SIZE, 4))
    for i, j in np.argwhere(profile.valid):
        h, d = float(profile.height[i, j]), float(profile.distance[i, j])
        t = np.clip((h - brush.low) / (brush.high - brush.low), 0, 1)
        rise = t * t * (3 - 2 * t)
        s = brush.width + brush.spread * np.sqrt(h / -float(profile.curvature[i, j]))
        radius = brush.radius * (1 - brush.grow + brush.grow * rise)
        line, whole = 2 * radius * np.sqrt(2 * np.pi) * s, np.pi * radius**2 * brush.aspect
        weight = (
            brush.flow * max(rise * np.exp(-(d**2) / (2 * s**2)) - 1e-3, 0) / (line * whole / np.hypot(line, whole))
        )
        along = np.array([-field.direction[i, j, 1], field.direction[i, j, 0]])
        x, y = COL - j, i - ROW
        u, v = (along[0] * x + along[1] * y) / radius, (along[0] * y - along[1] * x) / radius
        rgba = footprint(u, v, radius)
        total += weight * np.concatenate([np.asarray(brush.color) * rgba[..., 3:] * rgba[..., :3], rgba[..., 3:]], -1)
    depth = total[..., 3:]
    return total * np.where(depth > 0, -np.expm1(-depth) / np.where(depth > 0, depth, 1), 1)


def ellipse(aspect):
    def footprint(u, v, radius):
        alpha = np.clip((1 - np.hypot(u, v / aspect)) * radius * aspect + 0.5, 0, 1)
        return np.concatenate([np.ones((*u.shape, 3)), alpha[..., None]], -1)

    return footprint


def bar(u, v):
    return jnp.where(jnp.abs(v) < 0.3, 1 - jnp.abs(u), 0)


def bar_rgba(u, v, radius):
    inside = (np.abs(u) <= 1) & (np.abs(v) <= 1)
    alpha = np.where(inside & (np.abs(v) < 0.3), 1 - np.abs(u), 0)
    return np.concatenate([np.ones((*u.shape, 3)), alpha[..., None]], -1)


# ------------------------------------------------------------------------------------------- the definition


@pytest.mark.parametrize(
    ("footprint", "twin"),
    [("disc", ellipse(1.0)), ("ellipse", ellipse(0.5)), (bar, bar_rgba)],
    ids=["disc", "ellipse", "f"],
)
def test_equals_the_definition(footprint, twin):
    aspect = 0.5 if footprint == "ellipse" else 1.0
    brush = se.Brush(
        color=(0.9, 0.3, 0.1), radius=3.0, aspect=aspect, width=1.0, spread=0.1, low=0.1, high=1.5, grow=0.5, flow=1.0
    )
    profile, field = straight(angle=0.4, height=0.6 + 0.02 * X)
    got = se.draw_lines(profile, field, brush, footprint=footprint)
    np.testing.assert_allclose(got, definition(profile, field, brush, twin), atol=2e-5)


def test_compaction_changes_nothing():
    """The general variant, as traced, paints the same picture as the one that lists its stamps."""
    profile, field = straight(angle=0.9)
    brush = se.Brush(
        color=(0.2, 0.5, 0.9), radius=2.0, shortest=7.0, wobble=1.0, paper=0.5, gaps=0.5, tint=0.5, shade=0.5
    )
    rng = np.random.default_rng(1)
    noise = jnp.asarray(rng.random((SIZE, SIZE, CHANNELS)), jnp.float32)
    shading = jnp.asarray(rng.random((SIZE, SIZE, 3)), jnp.float32)
    listed = se.draw_lines(profile, field, brush, shading=shading, noise=noise)
    traced = jax.jit(lambda p: se.draw_lines(p, field, brush, shading=shading, noise=noise))(profile)
    np.testing.assert_allclose(listed, traced, atol=2e-5)


def test_images_are_footprints():
    """An image of a constant colour is the same as the function of that constant; its colour multiplies the brush's."""
    profile, field = straight(angle=0.4)
    brush = se.Brush(color=(1.0, 0.5, 0.25), radius=3.0, flow=1.0)
    image = np.broadcast_to(np.float32([0.5, 1.0, 0.2, 0.7]), (6, 5, 4))
    got = se.draw_lines(profile, field, brush, footprint=image)
    expected = se.draw_lines(profile, field, brush, footprint=lambda u, v: jnp.full_like(u, 0.7))
    np.testing.assert_allclose(got[..., 3], expected[..., 3], atol=1e-5)
    np.testing.assert_allclose(got[..., :3], np.asarray(expected[..., :3]) * [0.5, 1.0, 0.2], atol=1e-5)


# ------------------------------------------------------------------------------------------- what brushes do


def test_flow_is_the_optical_depth_in_the_middle_of_a_line():
    for radius, width in ((1.5, 0.8), (4.0, 0.8), (3.0, 1.2)):
        profile, field = straight(angle=0.0, offset=0.5)
        got = se.draw_lines(profile, field, se.Brush(radius=radius, width=width, flow=2.0))
        depth = -np.log(1 - np.asarray(got[SIZE // 2 - 1, SIZE // 2, 3]))
        assert abs(depth / 2 - 1) < 0.2


def test_alpha_is_below_one_and_colours_are_kept():
    profile, field = straight()
    got = np.asarray(se.draw_lines(profile, field, se.Brush(color=(0.8, 0.4, 0.1), flow=12.0, radius=3.0)))
    alpha = got[..., 3]
    assert alpha.max() <= 1
    inked = alpha > 1e-3
    np.testing.assert_allclose(
        got[inked][:, :3] / alpha[inked][:, None], np.broadcast_to([0.8, 0.4, 0.1], (inked.sum(), 3)), rtol=1e-4
    )
    assert not np.any(got[np.abs(Y) > 4 + 3 + 1])


def test_pencils_fade_with_the_height_and_airbrushes_spread_with_smoothness():
    pencil = se.Brush(low=0.0, high=1.0)
    profile, field = straight(height=(COL / SIZE))
    along = np.asarray(se.draw_lines(profile, field, pencil))[..., 3].max(axis=0)
    assert np.all(np.diff(along[3:-3]) > -1e-3)
    assert along[5] < 0.2 < 0.8 < along[-5]
    spread = [
        np.count_nonzero(np.asarray(se.draw_lines(*straight(curvature=c), se.Brush(spread=0.4)))[:, SIZE // 2, 3] > 0.1)
        for c in (-1.0, -0.05)
    ]
    assert spread[0] < spread[1]


def test_footprints_swell_with_the_width_of_the_profile():
    """TH10 fig. 8.5: wide valleys in wide strokes, fine ones in fine strokes, and none wider than the brush."""
    wide = []
    for curvature in (-1.0, -1 / 9, -1 / 400):  # half widths of 1, 3 and 20 px
        profile, field = straight(curvature=curvature)
        swelled = se.draw_lines(profile, field, se.Brush(radius=5.0, swell=1.0, width=0.5))
        plain = se.draw_lines(profile, field, se.Brush(radius=min(5.0, (-curvature) ** -0.5), width=0.5))
        np.testing.assert_allclose(swelled, plain, atol=1e-5)
        wide.append(np.count_nonzero(np.asarray(swelled)[:, SIZE // 2, 3] > 0.5))
    assert wide[0] < wide[1] < wide[2]


@pytest.mark.parametrize("angle", [0.0, 0.6])
def test_specks_are_left_out_and_lines_are_kept_to_their_ends(angle):
    """Of a line that is interrupted twice, the long pieces stay what they are, and the short one goes."""
    profile, field = straight(angle=angle)
    along = np.cos(angle) * X + np.sin(angle) * Y
    speck, left, right = np.abs(along) < 1.3, along < -8, along > 8

    def opacity(own, **options):
        drawn = replace(profile, valid=profile.valid & jnp.asarray(own))
        return np.asarray(se.draw_lines(drawn, field, se.Brush(**options), reach=3))[..., 3]

    plain, sifted = (opacity(speck | left | right, shortest=shortest) for shortest in (0.0, 5.0))
    assert plain[np.abs(along) < 1].max() > 0.5
    assert not np.any(sifted[np.abs(along) < 3])
    inner = (np.abs(along) > 10) & (np.abs(X) < 15) & (np.abs(Y) < 15)
    np.testing.assert_allclose(sifted[inner], plain[inner], atol=1e-5)
    ends = (np.abs(along) > 8) & (np.abs(along) < 10)
    assert sifted[ends].sum() > 0.85 * plain[ends].sum()


def test_colour_comes_from_the_shading_at_the_skeleton():
    profile, field = straight()  # along x, skeleton at Y = 0
    shading = np.zeros((SIZE, SIZE, 3), np.float32)
    shading[SIZE // 2 - 1 : SIZE // 2 + 1] = (0.1, 0.6, 0.9)  # only the two rows around the skeleton
    got = np.asarray(se.draw_lines(profile, field, se.Brush(shade=1.0, radius=3.0), shading=jnp.asarray(shading)))
    inked = got[..., 3] > 0.05
    inked[:, :5] = inked[:, -5:] = False
    np.testing.assert_allclose(
        got[inked][:, :3] / got[inked][:, 3:], np.broadcast_to([0.1, 0.6, 0.9], (inked.sum(), 3)), atol=1e-3
    )


def test_noise_interrupts_takes_off_and_moves():
    profile, field = straight()
    plain = np.asarray(se.draw_lines(profile, field, se.Brush()))
    gaps = np.asarray(se.draw_lines(profile, field, se.Brush(gaps=1.0), noise=noise_image(1.0)))
    assert not np.any(gaps)
    paper = np.asarray(se.draw_lines(profile, field, se.Brush(paper=0.5), noise=noise_image(1.0)))
    np.testing.assert_allclose(np.log1p(-paper[..., 3]), 0.5 * np.log1p(-plain[..., 3]), atol=1e-5)
    moved = np.asarray(se.draw_lines(profile, field, se.Brush(wobble=3.0), noise=noise_image(1.0)))
    lighter = np.asarray(
        se.draw_lines(profile, field, se.Brush(tint=1.0, color=(0.4, 0.2, 0.1)), noise=noise_image(1.0))
    )
    inked = plain[..., 3] > 0.1
    np.testing.assert_allclose(lighter[..., 3], plain[..., 3], atol=1e-6)  # tint changes the colour alone
    rgb = lighter[inked][:, :3] / lighter[inked][:, 3:]
    np.testing.assert_allclose(rgb, np.broadcast_to([0.9, 0.5, 0.3], rgb.shape), atol=1e-4)  # 2 c + 0.1
    # theta points up: stamps move three rows up
    np.testing.assert_allclose(moved[5:-8, 8:-8], plain[8:-5, 8:-8], atol=1e-5)


def test_noise_turns_and_resizes_footprints():
    """TH10 fig. 8.4: orientation as a field whose directions are turned, size as a smaller brush."""
    profile, field = straight(angle=0.3)
    x, y = field.direction[..., 0], field.direction[..., 1]
    cos, sin = np.cos(0.6), np.sin(0.6)
    turned = replace(field, direction=jnp.stack([cos * x - sin * y, sin * x + cos * y], -1))
    brush = se.Brush(radius=3.0, aspect=0.4, flow=1.0)
    plain, expected = (np.asarray(se.draw_lines(profile, f, brush, footprint="ellipse")) for f in (field, turned))
    twisted = replace(brush, twist=0.6)
    got = se.draw_lines(profile, field, twisted, footprint="ellipse", noise=noise_image(1.0))
    np.testing.assert_allclose(got, expected, atol=1e-5)
    assert np.max(np.abs(plain - expected)) > 0.05
    got = se.draw_lines(profile, field, twisted, footprint="ellipse", noise=noise_image(0.5))
    np.testing.assert_allclose(got, plain, atol=1e-5)
    smaller = se.draw_lines(profile, field, se.Brush(radius=3.0, uneven=0.5), noise=noise_image(0.8))
    np.testing.assert_allclose(smaller, se.draw_lines(profile, field, se.Brush(radius=1.8)), atol=1e-5)


def test_colours_may_be_any_sequence_of_three():
    profile, field = straight()
    noise, shading = noise_image(), jnp.full((SIZE, SIZE, 3), 0.5)
    for strengths in ({}, {"tint": 0.5}, {"shade": 0.5}):
        draw = lambda color, s=strengths: se.draw_lines(  # noqa: E731
            profile, field, se.Brush(color=color, **s), noise=noise, shading=shading
        )
        for color in ([1, 0, 0], np.array([1.0, 0.0, 0.0]), jnp.array([1, 0, 0])):
            np.testing.assert_array_equal(draw(color), draw((1.0, 0.0, 0.0)))
    for name, value in (
        ("color", [1, 0]),
        ("color", "red"),
        ("color", ["a", "b", "c"]),
        ("radius", [1.5]),
        ("flow", None),
    ):
        with pytest.raises(ValueError, match=rf"brush\.{name} "):
            se.draw_lines(profile, field, se.Brush(**{name: value}))


def test_composition_is_the_over_operator():
    picture = jnp.full((2, 2, 3), 0.5)
    strokes = jnp.broadcast_to(jnp.asarray([0.1, 0.0, 0.2, 0.25]), (2, 2, 4))
    np.testing.assert_allclose(se.composite_lines(picture, strokes)[0, 0], [0.475, 0.375, 0.575], rtol=1e-6)


# ------------------------------------------------------------------------------------------- silhouettes


def two_sheets(edge):
    """(gbuffer, descriptor) of a flat sheet before another one; `edge` [H, W]: where the one in front is seen."""
    depth = np.where(edge, 5.0, 8.0).astype(np.float32)
    position = np.stack([X, Y, -depth * SIZE], -1).astype(np.float32)
    normal = np.broadcast_to(np.float32([0, 0, 1]), (SIZE, SIZE, 3))
    mask = jnp.ones((SIZE, SIZE), bool)
    gbuffer = GBuffer(mask, jnp.asarray(depth * SIZE), jnp.asarray(normal), jnp.asarray(position))
    return gbuffer, se.describe(gbuffer)


@pytest.mark.parametrize("turned", [False, True])
def test_nothing_is_drawn_across_a_silhouette(turned):
    """A wide brush along a line that crosses the edge of a sheet, drawn on the one in front, or on the one behind."""
    edge = (X + 0.4 * Y < 3) if turned else (X < 3)
    gbuffer, descriptor = two_sheets(edge)
    brush = se.Brush(radius=5.0, color=(0.5, 0.2, 0.1))
    profile, field = straight(angle=0.3)
    for own in (edge, ~edge):
        drawn = replace(profile, valid=profile.valid & jnp.asarray(own))
        free = np.asarray(se.draw_lines(drawn, field, brush))
        held = np.asarray(se.draw_lines(drawn, field, brush, gbuffer=gbuffer, descriptor=descriptor))
        assert free[~own, 3].max() > 0.5  # it would spill over
        assert not np.any(held[~own])
        kept = np.abs(held - free)[own][:, 3] < 1e-6
        assert np.mean(kept) > (0.97 if turned else 1 - 1e-9)  # and nothing else changes
    if turned:  # the general variant, as traced, ends footprints at the same places
        traced = jax.jit(lambda p: se.draw_lines(p, field, brush, gbuffer=gbuffer, descriptor=descriptor))(drawn)
        np.testing.assert_allclose(traced, held, atol=2e-5)


def test_nothing_is_drawn_off_the_mask():
    gbuffer, _ = two_sheets(X < 100)
    gbuffer = replace(gbuffer, mask=jnp.asarray(Y < 2))
    profile, field = straight()
    args = {"gbuffer": gbuffer, "descriptor": se.describe(gbuffer)}
    got = np.asarray(se.draw_lines(profile, field, se.Brush(radius=4.0), **args))
    assert got[Y < 2].max() > 0.5
    drawn_on = Profile(*(getattr(profile, n) for n in ("distance", "height", "curvature")), profile.valid & (Y < 2))
    got = np.asarray(se.draw_lines(drawn_on, field, se.Brush(radius=4.0), **args))
    assert not np.any(got[Y > 2])


# ------------------------------------------------------------------------------------------- noise


def plane_gbuffer(camera, size=SIZE, z=-5.0):
    """A plane that faces the camera at depth 5, as seen by it."""
    p = np.asarray(camera.projection)
    x = ((np.arange(size) + 0.5) * 2 / size - 1) * -z / p[0, 0]
    position = np.stack([*np.meshgrid(x, -x), np.full((size, size), z)], -1)
    normal = np.broadcast_to(np.float32([0, 0, 1]), (size, size, 3))
    return GBuffer(
        jnp.ones((size, size), bool),
        *(jnp.asarray(a, jnp.float32) for a in (np.full((size, size), -z), normal, position)),
    )


def test_noise_sticks_to_the_surface():
    """A camera that moves sideways sees the noise move with the surface, not with the screen."""
    camera = se.perspective_camera((0, 0, 5), (0, 0, 0), fov_degrees=40, aspect=1.0)
    first = np.asarray(se.surface_noise(plane_gbuffer(camera), camera, size=5.0))
    assert first.shape == (SIZE, SIZE, CHANNELS)
    assert 0 <= first.min() < 0.2
    assert 0.8 < first.max() <= 1
    assert abs(first.mean() - 0.5) < 0.15
    pixel = 2 * 5 * np.tan(np.deg2rad(20)) / SIZE
    moved = se.perspective_camera((7 * pixel, 0, 5), (7 * pixel, 0, 0), fov_degrees=40, aspect=1.0)
    second = np.asarray(se.surface_noise(plane_gbuffer(moved), moved, size=5.0))
    np.testing.assert_allclose(second[:, :-7], first[:, 7:], atol=2e-3)
    assert np.mean(np.abs(second - first)) > 0.05


def test_noise_keeps_its_size_on_the_screen():
    rough = []
    for distance in (3.0, 5.0, 11.0):
        camera = se.perspective_camera((0, 0, distance), (0, 0, 0), fov_degrees=40, aspect=1.0)
        image = np.asarray(se.surface_noise(plane_gbuffer(camera, 64, -distance), camera, size=6.0))
        rough.append(np.mean(np.abs(np.diff(image, axis=0))))
    assert max(rough) < 1.6 * min(rough)


# ------------------------------------------------------------------------------------------- gradients, errors


@pytest.mark.slow
def test_the_whole_chain_under_vmap_and_jit():
    """Luminance to strokes, two pictures at once, is the same as one after the other."""
    images = jnp.asarray(
        np.stack([0.5 + 0.4 * np.tanh((X[12:28, 11:29] + a * Y[12:28, 11:29]) / 2) for a in (0.2, -0.6)])
    )

    def draw(image, radius):
        field = se.line_field("luminance", None, None, luminance=image, sigma=1.0)
        profile = se.fit_profile(field, least=0.02)
        return se.draw_lines(profile, field, se.Brush(radius=radius, low=0.02, high=0.1), reach=3)

    radii = jnp.asarray([1.5, 2.0])
    together = jax.jit(jax.vmap(draw))(images.astype(jnp.float32), radii)
    for k in range(2):
        alone = draw(images[k].astype(jnp.float32), float(radii[k]))
        assert np.max(np.asarray(alone)[..., 3]) > 0.5
        np.testing.assert_allclose(together[k], alone, atol=1e-4)


def test_gradients_end_where_footprints_end(x64):
    """Along a random direction, of stamps that a depth step cuts off, against differences."""
    gbuffer, descriptor = two_sheets(X + 0.4 * Y < 3)
    profile, field = jax.tree.map(lambda a: a if a.dtype == bool else a.astype(jnp.float64), straight(angle=0.3))
    rng = np.random.default_rng(2)
    change, weights = (jnp.asarray(rng.normal(size=s)) for s in (profile.distance.shape, (SIZE, SIZE, 4)))

    @jax.jit
    def value(step):
        bent = replace(profile, distance=profile.distance + step * change)
        brush = se.Brush(radius=3.0 + step, color=(0.5, 0.2, 0.1), grow=0.5 + step)
        sheets = {"gbuffer": gbuffer, "descriptor": descriptor}
        return jnp.sum(weights * se.draw_lines(bent, field, brush, footprint="ellipse", reach=4, **sheets))

    difference = (value(1e-6) - value(-1e-6)) / 2e-6
    assert abs(difference) > 1
    np.testing.assert_allclose(jax.grad(value)(0.0), difference, rtol=1e-6)


def test_gradients_are_finite_at_empty_profiles():
    zero = jnp.zeros((6, 7), jnp.float32)
    profile = Profile(zero, zero, zero, zero > 0)
    field = LineField(zero, jnp.zeros((6, 7, 2), jnp.float32), zero)
    brush = se.Brush(spread=0.5, grow=1.0)

    def value(profile, brush):
        return jnp.sum(se.draw_lines(profile, field, brush, reach=2))

    gradients = jax.grad(value, argnums=(0, 1), allow_int=True)(
        profile, jax.tree.map(jnp.float32, brush, is_leaf=lambda x: isinstance(x, tuple))
    )
    floats = [g for g in jax.tree.leaves(gradients) if jnp.issubdtype(g.dtype, jnp.floating)]
    assert all(np.all(np.isfinite(g)) for g in floats)
    assert not np.any(se.draw_lines(profile, field, brush))


def test_other_brushes_do_not_recompile(compilations):
    profile, field = straight()
    se.draw_lines(profile, field, se.Brush(radius=1.5))
    compilations.clear()
    se.draw_lines(*straight(angle=1.0), se.Brush(radius=1.2, flow=1.0, color=(1.0, 0.0, 0.0)))
    assert "jit(draw_listed)" not in compilations


@pytest.mark.parametrize(
    ("brush", "options", "message"),
    [
        (se.Brush(radius=0.0), {}, r"brush\.radius"),
        (se.Brush(flow=np.nan), {}, r"brush\.flow"),
        (se.Brush(low=1.0, high=0.5), {}, "accepted is low < high"),
        (se.Brush(paper=0.5), {}, "noise is None"),
        (se.Brush(shade=0.5), {}, "shading is None"),
        (se.Brush(color=(1.0, 1.0)), {}, r"brush\.color has shape"),
        (se.Brush(), {"footprint": "star"}, "footprint is 'star'"),
        (se.Brush(), {"reach": 100}, "reach is 100"),
    ],
)
def test_bad_arguments_are_named(brush, options, message):
    profile, field = straight()
    with pytest.raises(ValueError, match=message):
        se.draw_lines(profile, field, brush, **options)


@pytest.mark.parametrize("style", ["ink", "calligraphy", "shaded"])
def test_styles_draw(style):
    profile, field = straight()
    brush = se.style_brush(style, "valley", height=600)
    got = se.draw_lines(
        profile,
        field,
        brush,
        footprint=se.style_footprint(style),
        shading=jnp.ones((SIZE, SIZE, 3)),
        noise=noise_image(),
    )
    assert np.asarray(got)[..., 3].max() > 0.5
    with pytest.raises(ValueError, match="style is 'crayon'"):
        se.style_brush("crayon", "valley")

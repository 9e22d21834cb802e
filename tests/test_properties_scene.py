"""Hostile meshes, points, maps and cameras, and fits from any start: what comes out is finite, and so are gradients."""

import dataclasses
import warnings

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se
from tests import hostile
from tests.absences import NOT_NUMERIC
from tests.programs import Counted

SHAPE = 9, 11


def checked(function):
    """(arguments, *held) -> None: jit of value and gradient, of which everything must be finite."""

    def value(floats, *held):
        out = [leaf for leaf in jax.tree.leaves(function(floats, *held)) if hostile.is_float(leaf)]
        return sum(jnp.sum(leaf) for leaf in out), out

    both = Counted(jax.value_and_grad(value, argnums=0, has_aux=True))

    def check(floats, *held, about=""):
        (_, out), gradients = both(floats, *held)
        assert all(np.all(np.isfinite(leaf)) for leaf in out), about
        for path, leaf in jax.tree_util.tree_leaves_with_path(gradients):
            assert np.all(np.isfinite(leaf)), f"{about}: gradient in {jax.tree_util.keystr(path)}"
        assert both.traces == 1
        return out

    return check


# ------------------------------------------------------------------------------------------- meshes and points

GEOMETRIES = (
    "torus",
    "flat",
    "one point",
    "huge",
    "tiny",
    "behind",
    "through the eye",
    "repeated faces",
    "zero normals",
)


def geometry(kind, seed):
    """(vertices, faces, normals): a torus, and what may be wrong with it, float32."""
    rng = np.random.default_rng(seed)
    mesh = se.torus(segments=4)
    vertices, faces, normals = (np.array(a) for a in (mesh.vertices, mesh.faces, mesh.normals))
    vertices += np.float32([0, 0, -3]) + 0.1 * rng.normal(size=vertices.shape).astype(np.float32)
    if kind == "flat":
        vertices[:, 1] = 0
    elif kind == "one point":
        vertices[:] = vertices[0]
    elif kind in ("huge", "tiny"):
        vertices *= np.float32(1e6 if kind == "huge" else 1e-6)
    elif kind in ("behind", "through the eye"):
        vertices[:, 2] += np.float32(6 if kind == "behind" else 3)
    elif kind == "repeated faces":
        faces[::2] = faces[0]
        faces[1::4, 1] = faces[1::4, 0]
    elif kind == "zero normals":
        normals[::2] = 0
    return vertices, faces, normals


def inputs(kind, seed):
    """(what gradients are taken in, faces): also texture coordinates and texels that are as bad."""
    vertices, faces, normals = geometry(kind, seed)
    rng = np.random.default_rng(seed + 9)
    texels = rng.normal(size=(4, 5, 3)) * rng.choice([0, 1, 1e-30, 1e30], size=(4, 5, 1))
    texels[0, 0], texels[1, 1] = np.nan, np.inf
    uv = vertices[:, :2] * 10.0 ** (3 * seed - 3) if seed else np.zeros((len(vertices), 2))
    eye = se.perspective_camera((0.0, 0, 0), (0.0, 0, -3), fov_degrees=40.0, aspect=SHAPE[1] / SHAPE[0])
    made = {"vertices": vertices, "normals": normals, "uv": uv, "texels": texels, "camera": eye}
    made |= {"radius": 0.3 * 10.0 ** (seed - 1), "strength": (0.0, 1.0, 100.0)[seed]}
    return jax.tree.map(lambda a: np.asarray(a, np.float32), made), faces


def mesh_of(i, faces):
    return se.Mesh(i["vertices"], faces, i["normals"], uv=i["uv"])


SIZE = {"height": SHAPE[0], "width": SHAPE[1]}


def seen_mesh(i, faces):
    return se.render_gbuffer(mesh_of(i, faces), i["camera"], uv=True, **SIZE)


def seen_points(i, faces):
    return se.gbuffer_from_points(i["vertices"], i["normals"], i["radius"], i["camera"], tolerance=1.0, **SIZE)


def interpolated(i, faces):
    mesh = mesh_of(i, faces)
    seen = se.rasterize(mesh, i["camera"], **SIZE)
    return se.interpolate(i["normals"], mesh, i["camera"], seen), se.barycentrics(mesh, i["camera"], seen)


def mapped(space):
    def function(i, faces):
        mesh, camera = mesh_of(i, faces), i["camera"]
        seen, gbuffer = se.rasterize(mesh, camera, **SIZE), se.render_gbuffer(mesh, camera, uv=True, **SIZE)
        options = {"strength": i["strength"], "space": space, "check": False}
        return se.apply_normal_map(gbuffer, mesh, camera, seen, i["texels"], **options).normal

    return function


def sampled(i, faces):
    mesh, camera = mesh_of(i, faces), i["camera"]
    gbuffer = se.render_gbuffer(mesh, camera, **SIZE)
    coverage = se.sample_coverage(mesh, camera, gbuffer, samples=2)
    return coverage, se.resolve_coverage(gbuffer.position, coverage)


def rendered(i, faces):
    light = se.Lights(np.float32([[0, 0.6, 0.8], [0.6, 0, -0.8]]), np.float32([[1, 1, 1], [0, 1e6, 0]]))
    warp = se.LightWarp(1e3 * i["radius"], i["strength"] / 100)
    return se.render(
        mesh_of(i, faces), i["camera"], light, se.Material(jnp.full(3, 0.5)), warp, sigma=i["radius"], **SIZE
    )


def tables(i, faces):
    mesh = se.make_mesh(i["vertices"], faces)
    padded = se.pad_mesh(mesh)
    curvature = se.vertex_curvature(dataclasses.replace(mesh, normals=i["normals"]))
    return mesh.normals, se.vertex_normals(i["vertices"], faces), padded.vertices, padded.normals, curvature


def framed(i, faces):
    camera = se.frame_mesh(mesh_of(i, faces))
    return camera.view, camera.projection


SLOW, THOROUGH = pytest.mark.slow, pytest.mark.thorough  # what `mapped` interpolates, and samples, in their own tests


@pytest.mark.parametrize(
    "function",
    [
        seen_mesh,
        pytest.param(seen_points, marks=SLOW),
        pytest.param(interpolated, marks=THOROUGH),
        pytest.param(mapped("tangent"), marks=SLOW),
        pytest.param(mapped("object"), marks=THOROUGH),
        pytest.param(sampled, marks=THOROUGH),
        pytest.param(rendered, marks=THOROUGH),
        tables,
        framed,
    ],
    ids=["seen_mesh", "seen_points", "interpolated", "tangent", "object", "sampled", "rendered", "tables", "framed"],
)
def test_hostile_geometry_gives_finite_pictures_and_gradients(function):
    check = checked(function)
    for kind in GEOMETRIES:
        for seed in range(3):
            floats, faces = inputs(kind, seed)
            check(floats, faces, about=f"{kind} {seed}")


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_normals_and_radii_of_any_point_cloud_are_usable(kind):
    points, _, _ = geometry(kind, 1)
    np.testing.assert_allclose(np.linalg.norm(se.estimate_normals(points, neighbors=4), axis=-1), 1, rtol=1e-6)
    radius = se.estimate_radius(points, neighbors=4)
    assert np.all(np.isfinite(radius) & (radius > 0))


# ------------------------------------------------------------------------------------------- cameras

EYES = {
    "plain": ([0, 0, 3], [0, 0, 0], [0, 1, 0]),
    "up along the view": ([0, 0, 3], [0, 0, 0], [0, 0, 1]),
    "no up": ([0, 0, 3], [0, 0, 0], [0, 0, 0]),
    "target at the eye": ([0, 0, 3], [0, 0, 3], [0, 1, 0]),
    "far": ([0, 1e12, 3e12], [0, 0, 0], [0, 1e12, 0]),
    "near": ([0, 0, 1e-12], [0, 0, 0], [0, 1e-12, 0]),
}


def cameras(i):
    rest = {"up": i["up"], "aspect": i["aspect"]}
    return (
        se.perspective_camera(i["eye"], i["target"], fov_degrees=i["fov"], **rest),
        se.orthographic_camera(i["eye"], i["target"], height=i["height"], **rest),
    )


def test_cameras_that_cannot_look_are_finite_when_traced_and_refused_when_not():
    check = checked(cameras)
    for kind, where in EYES.items():
        for fov, height in ((30.0, 1.0), (1e-3, 1e-6), (179.9, 1e6)):
            named = dict(zip(("eye", "target", "up"), (np.float32(a) for a in where), strict=True))
            given = named | {"fov": np.float32(fov), "height": np.float32(height), "aspect": np.float32(1.3)}
            check(given, about=f"{kind} {fov}")
        if kind in ("up along the view", "no up", "target at the eye"):
            with pytest.raises(ValueError, match="accepted"):
                cameras(given)


# ------------------------------------------------------------------------------------------- maps

MAPS = ("plain", "one pixel", "a pole", "dark", "bright", "negative", "nan", "infinite", "one texel")


def radiance_map(kind, seed):
    rng = np.random.default_rng(seed)
    image = rng.uniform(0, 1, (6, 12, 3)) * rng.choice([0, 1, 1e4], size=(6, 12, 1))
    image[2, 3] = 1
    if kind in ("one pixel", "a pole"):
        keep = image[2, 3].copy()
        image[:] = 0
        image[2 if kind == "one pixel" else 0, 3] = keep
    elif kind in ("dark", "bright"):
        image *= 1e-30 if kind == "dark" else 1e30
    elif kind in ("negative", "nan", "infinite"):
        image[rng.random(image.shape[:2]) < 0.3] = {"negative": -5, "nan": np.nan, "infinite": np.inf}[kind]
    elif kind == "one texel":
        image = np.ones((1, 1, 3))
    return image.astype(np.float32)


@pytest.mark.parametrize("method", ["uniform", "importance", "median_cut"])
@pytest.mark.parametrize("count", [1, 7, 100])
def test_lights_of_any_map_are_unit_finite_and_hold_its_energy(method, count):
    """100 lights are more than the map has pixels; traced and concrete agree."""
    check = checked(lambda i: se.sample_environment(i["map"], count, rotation=i["angle"], method=method))
    small = checked(lambda i: se.sample_environment(i["map"], count, rotation=i["angle"], method=method))
    for kind in MAPS:
        for seed, angle in enumerate((0.0, 1.0, 1e6)):
            image = radiance_map(kind, seed)
            run = small if kind == "one texel" else check
            direction, radiance = run({"map": image, "angle": np.float32(angle)}, about=f"{kind} {seed}")
            np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1, atol=1e-5)
            assert np.all(radiance >= 0)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # says how many pixels it replaced
                concrete = se.sample_environment(image, count, rotation=angle, method=method)
            np.testing.assert_allclose(concrete.radiance, radiance, rtol=1e-5, atol=1e-6 * np.max(radiance))
            np.testing.assert_allclose(concrete.direction, direction, atol=1e-5)
            clean = np.nan_to_num(np.maximum(image, 0), nan=0, posinf=np.max(image[np.isfinite(image)])).astype(float)
            edge = np.cos(np.linspace(0, np.pi, len(image) + 1))
            solid = (edge[:-1] - edge[1:])[:, None, None] * 2 * np.pi / image.shape[1]
            np.testing.assert_allclose(
                np.sum(radiance, axis=0, dtype=float), np.sum(clean * solid, axis=(0, 1)), rtol=1e-4
            )


def test_maps_without_energy_give_dark_lights_when_traced_and_are_refused_when_not():
    check = checked(lambda i: se.sample_environment(i["map"], 5))
    for value in (0.0, -1.0, np.nan, -np.inf):
        image = np.full((6, 12, 3), value, np.float32)
        direction, radiance = check({"map": image})
        np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1, atol=1e-5)
        assert np.all(radiance == 0)
        with pytest.raises(ValueError, match="no energy"):
            se.sample_environment(image, 5)


# ------------------------------------------------------------------------------------------- lines that are shown


@hypothesis.settings(max_examples=25, deadline=None, derandomize=True, database=None)
@hypothesis.given(draw=hostile.draws, length=st.sampled_from((1.0, 7.5, 1000.0)))
def test_smeared_noise_is_a_shade_of_grey(draw, length):
    i = hostile.images(draw, SHAPE, np.float32)
    noise = np.nan_to_num(i["noise"][..., 0])
    out = se.line_integral_convolution(i["gradient"], mask=i["mask"], length=length, noise=noise)
    assert out.shape == SHAPE
    assert np.all((out >= 0) & (out <= 1))
    assert np.all(out[~i["mask"]] == 1)


# ------------------------------------------------------------------------------------------- fits


@hypothesis.settings(max_examples=40, deadline=None, derandomize=True, database=None)
@hypothesis.given(
    interval=st.sampled_from(((-1e6, 1e6), (-1.0, 0.5), (0.0, 1e-6), (1e-3, 1e6), (-1e30, 1e30))),
    start=st.floats(0, 1),
    share=st.floats(0.02, 0.98),
    waves=st.integers(0, 3),
    bad=st.sampled_from((0.0, np.nan, np.inf)),
)
def test_any_start_meets_any_target_within_reach_whatever_the_bounds(interval, start, share, waves, bad):
    """A contrast between 0.05 and 0.55 that waves on its way; a pixel that is not finite does not count."""
    base = np.float32([[1, -1, 1, -1, 0], [1, -1, 1, -1, 0]])
    mask = np.ones(base.shape, bool)
    low, high = np.float32(interval)
    width = high - low

    def strength(u):
        return 0.05 + 0.5 * (0.5 * u + 0.5 * jnp.square(jnp.sin(jnp.pi * (waves + 0.5) * u)))

    def render(value):
        picture = 1 + strength((value - low) / width) * base
        return jnp.where(jnp.arange(5) == 4, bad, picture) if bad else picture

    ends = [float(se.contrast(render(low + jnp.float32(u) * width), mask)) for u in (0.0, 1.0)]
    target = ends[0] + share * (ends[1] - ends[0])
    begin = np.clip(low + np.float32(start) * width, low, high)
    found = se.fit_contrast(render, target, begin, mask=mask, bounds=interval)
    assert np.isfinite(found.parameters)
    assert found.converged, found.reason
    assert float(se.contrast(render(found.parameters), mask)) == pytest.approx(target, rel=2e-4)
    again = se.fit_image(render, render(found.parameters), found.parameters, mask=mask, bounds=interval)
    assert again.converged
    assert again.value < 1e-5


# ------------------------------------------------------------------------------------------- completeness


def test_every_public_function_of_arrays_meets_hostile_inputs():
    from pathlib import Path

    text = "".join(path.read_text() for path in Path(__file__).parent.glob("test_properties*.py"))
    numeric = set(se.__all__) - {name for names in NOT_NUMERIC.values() for name in names.split()}
    assert {name for name in numeric if f"se.{name}(" not in text} == set()

"""A contact sheet: materials by rows, original, warped, scaled and both by columns.

python examples/materials.py [MESH] [--env MAP] [--height 240] [-o materials.png]
"""

import argparse

import jax.numpy as jnp
import numpy as np

import shapeenh as se

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("mesh", nargs="?", help="default: the embedded carved knot")
parser.add_argument("--env", help="a radiance map; default: the procedural studio")
parser.add_argument("--height", type=int, default=240, help="rows of one picture")
parser.add_argument("--view", type=float, nargs=3, default=(0.34, 0.26, 0.90), metavar=("X", "Y", "Z"))
parser.add_argument("-o", "--output", default="materials.png")
arguments = parser.parse_args()

height, width = arguments.height, arguments.height
mesh = se.load_mesh(arguments.mesh) if arguments.mesh else se.carved_knot()
radiance_map = jnp.maximum(se.load_environment(arguments.env), 0) if arguments.env else se.procedural_studio()
camera = se.frame_mesh(mesh, direction=arguments.view, aspect=1.0)
gbuffer = se.render_gbuffer(mesh, camera, height=height, width=width)
scale = height / 600  # strengths are meant for 600 rows
descriptor = se.describe(gbuffer, sigma=2.5 * scale)
lights = se.rotate_lights(se.sample_environment(radiance_map, 64), camera)
turn = np.asarray(camera.view)[:3, :3].T
alpha = 40.0 * scale
# Radiance scaling reads curvature as it is, in 1/px: 20 brings it to the range where tanh bends.
strong = se.Descriptor(
    hessian=20.0 * scale * descriptor.hessian,
    gradient=descriptor.gradient,
    silhouette=descriptor.silhouette,
    crease=descriptor.crease,
    conductance=descriptor.conductance,
)

# The four ways: (alpha, gamma); where a look is scaled and warped with one Hessian, alpha is divided by its factor.
WAYS = {"original": (0.0, 0.0), "warped": (alpha, 0.0), "scaled": (0.0, 2.0), "both": (alpha, 2.0)}


def summed(material):
    def shade(a, g):
        options = {"invariant": 0.3, "gamma_diffuse": g, "gamma_specular": g, "alpha": a / (20.0 * scale)}
        return se.shade_scaled(gbuffer, strong, lights, material, **options)

    return shade


def looked_up(function, table, invariant=0.3, **fixed):
    def shade(a, g):
        options = {"descriptor": strong, "alpha": a / (20.0 * scale), "gamma": g, "invariant": invariant}
        return function(gbuffer, table, rotation=turn, **options, **fixed)

    return shade


two_lamps = se.Lights(
    jnp.asarray([[-0.55, 0.6, 0.58], [0.8, 0.1, 0.59]]), jnp.asarray([[1.0, 0.96, 0.9], [0.2, 0.25, 0.32]])
)


def phong(a, g):
    strengths = {"gamma_ambient": g, "gamma_diffuse": g, "gamma_specular": g}
    colours = {"ambient": 0.06, "diffuse": jnp.asarray([0.6, 0.35, 0.25]), "specular": 0.4, "shininess": 40.0}
    return se.shade_phong(gbuffer, two_lamps, descriptor=strong, alpha=a / (20.0 * scale), **strengths, **colours)


def ball(top, bottom, rim):
    """A painted ball: from `bottom` to `top`, darker at the rim, with a highlight."""
    row, column = np.mgrid[:128, :128]
    x, y = (column + 0.5) / 64 - 1, 1 - (row + 0.5) / 64
    facing = np.sqrt(np.maximum(1 - x * x - y * y, 0))[..., None]
    up = (0.5 + 0.5 * (0.5 * y - 0.3 * x))[..., None]
    base = np.asarray(bottom) * (1 - up) + np.asarray(top) * up
    shine = np.exp(-(((x + 0.35) ** 2 + (y - 0.45) ** 2) / 0.03))[..., None]
    return jnp.asarray(base * (rim + (1 - rim) * facing) + 0.6 * shine, jnp.float32)


warm, cold = ball((1.0, 0.75, 0.5), (0.35, 0.12, 0.08), 0.4), ball((0.25, 0.3, 0.5), (0.05, 0.06, 0.15), 0.6)


def painted(a, g):
    bent = gbuffer
    if a:
        tensor = se.warp_tensor(strong.hessian, a / (20.0 * scale))
        bent = se.GBuffer(gbuffer.mask, gbuffer.depth, se.warp(gbuffer.normal, tensor), gbuffer.position)
    image = se.lit_sphere(bent, warm, concave=cold, descriptor=strong, transition=0.6)
    level = jnp.clip(image @ jnp.asarray([0.2126, 0.7152, 0.0722]), 0, 1)
    kappa = se.curvature_mapping(strong.hessian, gbuffer.normal, 0.0)
    return image * se.radiance_scale(kappa, level, 0.3, g)[..., None]


LOOKS = {
    "diffuse": looked_up(se.shade_diffuse, se.prefilter_map(radiance_map), albedo=0.8),
    "matt": summed(se.named_material("plaster")),
    "glossy": summed(se.named_material("porcelain")),
    "metal": summed(se.named_material("bronze")),
    "mirror": looked_up(se.shade_mirror, radiance_map, 0.1),
    "refraction": looked_up(se.shade_refraction, radiance_map, 0.1),
    "Phong": phong,
    "lit spheres": painted,
}

rows = []
for name, look in LOOKS.items():
    images = [look(*way) for way in WAYS.values()]
    exposure = se.auto_exposure(images[0], gbuffer.mask)
    mask = gbuffer.mask[..., None]
    rows.append(np.concatenate([np.where(mask, se.tone_map(i, exposure=exposure), 0.5) for i in images], axis=1))
    spread = {way: float(np.std(np.asarray(i)[np.asarray(gbuffer.mask)])) for way, i in zip(WAYS, images, strict=True)}
    print(f"{name:12}", {way: round(s / spread["original"], 3) for way, s in spread.items()}, "(spread over original)")
se.save_image(arguments.output, np.concatenate(rows, axis=0))
print(arguments.output)

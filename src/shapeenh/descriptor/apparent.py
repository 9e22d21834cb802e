"""Object-centred and apparent curvature (TH10 4.1 and 4.2.1, SPEC 4)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from shapeenh.checks import check_shape, check_type
from shapeenh.descriptor import edges, gradient
from shapeenh.descriptor.view import check_gbuffer, describe
from shapeenh.fusion import stored, unknown_truth
from shapeenh.numerics import eigenvalues, safe_divide, safe_hypot, safe_sqrt
from shapeenh.stencils import derivatives, links
from shapeenh.types import Camera, Descriptor

# ------------------------------------------------------------------------------------------- object-centred


def describe_object(gbuffer, tensor, camera) -> Descriptor:
    """The object-centred descriptor: the surface's own curvature, whatever the view (TH10 4.1, SPEC 4).

    gbuffer: GBuffer with depth and positions.
    tensor: [H, W, 6], `vertex_curvature(mesh)` interpolated: world space, 1/world unit.
    camera: Camera, the one that made the G-buffer.
    Returns a Descriptor, 0 off the mask. Its Hessian has the principal curvatures as eigenvalues, in 1/px at the depth
    of the pixel, and is stated in the image axes turned into the tangent plane by the smallest rotation; its gradient,
    silhouettes and conductance are those of `describe`; where silhouettes are, curvature stays.
    Gradient: with respect to the tensor, normals and positions.
    Errors: ValueError for shapes that disagree.
    """
    check_gbuffer(gbuffer)
    check_type("camera", camera, Camera)
    check_shape("tensor", tensor, (*gbuffer.mask.shape, 6))
    return _describe_object(gbuffer, tensor, camera.view)


@jax.jit
def _describe_object(gbuffer, tensor, view):
    plain = describe(gbuffer)
    normal, good = gradient.normal_planes(gbuffer)
    finite = good & jnp.isfinite(gbuffer.depth) & jnp.all(jnp.isfinite(gbuffer.position), axis=-1)
    position = [jnp.where(finite, gbuffer.position[..., i], 0) for i in range(3)]
    size = edges.footprint(position, jnp.where(finite, gbuffer.depth, 1), finite)

    # the image axes, turned from z to n by the smallest rotation: x - (x.n)/(1 + n_z) (z + n), seen from the world
    length = jnp.sqrt(jnp.maximum(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2], 0.25))
    n = [plane / length for plane in normal]
    shrink = 1 / jnp.maximum(1 + n[2], 1e-6)
    n_x, n_y = n[0], n[1]
    axes = (
        (1 - n_x * n_x * shrink, -n_x * n_y * shrink, -n_x),
        (-n_x * n_y * shrink, 1 - n_y * n_y * shrink, -n_y),
    )
    world = [[sum(view[k, i] * axis[k] for k in range(3)) for i in range(3)] for axis in axes]
    safe = jnp.where(good[..., None] & jnp.isfinite(tensor), tensor, 0)
    t = {}
    for k, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        t[i, j] = t[j, i] = safe[..., k]
    image = lambda a, b: sum(world[a][i] * t[i, j] * world[b][j] for i in range(3) for j in range(3))  # noqa: E731
    hessian = jnp.stack([image(0, 0), image(0, 1), image(1, 1)], axis=-1) * size[..., None]
    return Descriptor(hessian, plain.gradient, plain.silhouette, plain.crease, plain.conductance)


# ------------------------------------------------------------------------------------------- apparent


def describe_apparent(gbuffer) -> Descriptor:
    """Apparent curvature: how fast the normal turns along the screen (Judd et al. 2007, TH10 4.2.1, SPEC 4).

    gbuffer: GBuffer.
    Returns a Descriptor as `describe` gives it, but for the Hessian: q t t^T with q the largest singular value of the
    derivative of the normal, 1/px, t the screen direction it belongs to, and the sign of the curvature along t
    (convexities negative). The operator is not symmetric, its second value has no direction of its own: it is left out.
    0 off the mask.
    Gradient: with respect to normals; exact off umbilics, finite there.
    Errors: ValueError for fields whose shapes disagree.
    """
    check_gbuffer(gbuffer)
    return _describe_apparent(gbuffer)


@jax.jit
def _describe_apparent(gbuffer):
    always = unknown_truth(gbuffer.normal, gbuffer.position)
    plain = describe(gbuffer)
    normal, _ = stored(always, gradient.normal_planes, gbuffer)
    link_x, link_y = links(plain.conductance)
    d_x, d_y = derivatives(jnp.stack(normal[:2]), link_x, link_y, always)
    # the third component follows from the length, n . dn = 0; it grows without bound at the outline, and so does q
    n_z = jnp.maximum(normal[2], gradient.LEAST_NZ)
    z_x = -(normal[0] * d_x[0] + normal[1] * d_x[1]) / n_z
    z_y = -(normal[0] * d_y[0] + normal[1] * d_y[1]) / n_z
    gram = jnp.stack(
        [
            d_x[0] ** 2 + d_x[1] ** 2 + z_x**2,
            d_x[0] * d_y[0] + d_x[1] * d_y[1] + z_x * z_y,
            d_y[0] ** 2 + d_y[1] ** 2 + z_y**2,
        ],
        axis=-1,
    )
    largest, least = eigenvalues(gram)
    q = safe_sqrt(largest)
    # t t^T = (G - least I) / (largest - least), any direction at umbilics
    spread = largest - least
    a, b = 0.5 * gram[..., 0] - 0.5 * gram[..., 2], gram[..., 1]
    r = safe_hypot(a, b)
    cos, sin = jnp.where(spread > 0, safe_divide(a, r), 1), safe_divide(b, r)  # of twice the angle
    t_xx, t_xy, t_yy = 0.5 + 0.5 * cos, 0.5 * sin, 0.5 - 0.5 * cos
    h = plain.hessian
    bend = t_xx * h[..., 0] + 2 * t_xy * h[..., 1] + t_yy * h[..., 2]
    q = jnp.where(bend > 0, q, -q) * plain.conductance
    hessian = jnp.stack([q * t_xx, q * t_xy, q * t_yy], axis=-1)
    return Descriptor(hessian, plain.gradient, plain.silhouette, plain.crease, plain.conductance)

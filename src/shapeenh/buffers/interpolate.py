"""Vertex attributes at the pixels: perspective-correct, with exact gradients (SPEC 11)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from shapeenh import checks
from shapeenh.buffers.inputs import check_camera, check_mesh, check_table
from shapeenh.buffers.project import clip_matrix
from shapeenh.buffers.resolve import Finish, resolve
from shapeenh.buffers.weights import planes
from shapeenh.types import Camera, Mesh, Visibility


def interpolate(attribute, mesh: Mesh, camera: Camera, visibility: Visibility):
    """A vertex attribute at the pixel centres, perspective-correct.

    Source: SPEC 11; Olano and Greer 1997 (homogeneous barycentrics).
    attribute: [V, C], any unit. visibility: of the same mesh and camera, from `rasterize`.
    Returns [H, W, C]; 0 off the mask.
    *Gradient*: exact with respect to attribute, mesh.vertices and both camera matrices, in reverse mode, by hand; the
    visibility is a constant. The sums over pixels are taken in a fixed order on CPU.
    *Errors*: ValueError for wrong shapes, and for values that are not finite where they can be looked at.
    """
    check_seen(mesh, camera, visibility)
    check_table("attribute", attribute, mesh, None)
    dtype = checks.float_dtype(attribute, mesh.vertices, camera.view, camera.projection)
    arrays = [jnp.asarray(a, dtype) for a in (attribute, mesh.vertices, camera.view, camera.projection)]
    return interpolated(*arrays, jnp.asarray(mesh.faces, jnp.int32), visibility.triangle)


def barycentrics(mesh: Mesh, camera: Camera, visibility: Visibility):
    """The perspective-correct weights of the three corners of the face that each pixel centre sees (SPEC 2, 11).

    Returns [H, W, 3], in the order of the face's corners, summing to 1; 0 off the mask. A weight may be slightly
    outside of [0, 1] where snapping to 1/256 px made the pixel belong to the face.
    *Gradient*: exact with respect to mesh.vertices and both camera matrices.
    *Errors*: ValueError for wrong shapes.
    """
    check_seen(mesh, camera, visibility)
    dtype = checks.float_dtype(mesh.vertices, camera.view, camera.projection)
    arrays = [jnp.asarray(a, dtype) for a in (mesh.vertices, camera.view, camera.projection)]
    return weights(*arrays, jnp.asarray(mesh.faces, jnp.int32), visibility.triangle)


def check_seen(mesh, camera, visibility) -> None:
    checks.check_type("mesh", mesh, Mesh)
    checks.check_type("camera", camera, Camera)
    checks.check_type("visibility", visibility, Visibility)
    checks.check_shape("visibility.triangle", visibility.triangle, (None, None))
    check_mesh(mesh)
    check_camera(camera)


def attributes(stage, write, view, w, blended, rows):
    return [write(planes, blended[1])]


def attributes_reverse(stage, view, w, blended, rows, cotangents):
    return jnp.zeros_like(view), None, [None, cotangents[0]]


def corner_weights(stage, write, view, w, blended, rows):
    return [write(lambda w: planes(w)[:3], w)]


def corner_weights_reverse(stage, view, w, blended, rows, cotangents):
    return jnp.zeros_like(view), cotangents[0], [None]


ATTRIBUTES = Finish(attributes, attributes_reverse)
CORNER_WEIGHTS = Finish(corner_weights, corner_weights_reverse)


@jax.jit
def interpolated(attribute, vertices, view, projection, faces, triangle):
    return resolved(ATTRIBUTES, attribute.shape[1], vertices, (attribute,), view, projection, faces, triangle)


@jax.jit
def weights(vertices, view, projection, faces, triangle):
    return resolved(CORNER_WEIGHTS, 3, vertices, (), view, projection, faces, triangle)


def resolved(finish, channels, vertices, tables, view, projection, faces, triangle):
    if faces.shape[0] == 0 or vertices.shape[0] == 0 or channels == 0:
        return jnp.zeros((*triangle.shape, channels), vertices.dtype)
    m, _ = clip_matrix(view, projection)
    return resolve(finish, vertices, list(tables), view, m, faces, triangle)[0]

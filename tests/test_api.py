"""The public names: flat, sorted, documented, options keyword-only."""

import dataclasses
import inspect

import pytest

import shapeenh as se

# Parameters with a default that may be given by position, because they are arrays or records.
POSITIONAL_DEFAULTS = {("render", "enhancement"), ("enhance", "enhancement")}
FUNCTIONS = sorted(n for n in se.__all__ if inspect.isroutine(getattr(se, n)) or not inspect.isclass(getattr(se, n)))


def test_names_are_sorted_and_exist():
    assert list(se.__all__) == sorted(se.__all__, key=lambda n: (not n[0].isupper(), n))
    assert all(hasattr(se, name) for name in se.__all__)


def test_the_contract_is_there():
    wanted = """load_mesh load_environment save_image perspective_camera orthographic_camera frame_mesh rasterize
    interpolate render_gbuffer describe mean_curvature gaussian_curvature principal_curvatures principal_directions
    warp_tensor warp unwarp warp_jacobian ashikhmin_shirley sample_environment rotate_lights shade_warped shade render
    shade_scaled curvature_mapping radiance_scale gbuffer_from_normals gbuffer_from_height gbuffer_from_points
    vertex_curvature describe_object describe_apparent describe_relief line_field fit_profile draw_lines
    contrast fit_contrast
    LightWarp RadianceScaling Mesh Camera Visibility GBuffer Descriptor Lights Material LineField Profile"""
    assert set(wanted.split()) <= set(se.__all__)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_options_are_keyword_only_and_documented(name):
    function = getattr(se, name)
    assert inspect.getdoc(function), f"{name} has no docstring"
    for parameter in inspect.signature(function).parameters.values():
        if parameter.default is not parameter.empty and (name, parameter.name) not in POSITIONAL_DEFAULTS:
            assert parameter.kind is parameter.KEYWORD_ONLY, f"{name}({parameter.name}=...) is not keyword-only"


@pytest.mark.parametrize("name", [n for n in se.__all__ if dataclasses.is_dataclass(getattr(se, n))])
def test_records_document_every_field(name):
    record = getattr(se, name)
    for field in dataclasses.fields(record):
        assert field.name in inspect.getdoc(record), f"{name}.{field.name} is not documented"

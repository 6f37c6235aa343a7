import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from registration.errors import InputError
from registration.model import gnm_npz, gnmw
from tests.conftest import SHARED, needs_shared
from tests.fixtures.make_fixtures import tiny_model

DATA = tiny_model()


def file_bytes(header: dict, body: bytes, *, version: int = 1, magic: bytes = b"GNMW") -> bytes:
    """A container, written here from the public description alone."""
    text = json.dumps(header, separators=(",", ":"), sort_keys=True).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sII", magic, version, len(text)) + text + body


def small() -> tuple[dict, bytes]:
    """Header and body of a model of 4 vertices, 2 triangles, 2 identity and 1 expression components."""
    arrays = {
        "vertices": np.arange(12, dtype="<f4").reshape(4, 3),
        "triangles": np.array([[0, 1, 2], [1, 2, 3]], "<u4"),
        "identity_quantized": np.arange(-12, 12, dtype="i1").reshape(2, 12),
        "identity_scales": np.array([0.5, 0.25], "<f4"),
        "expression_quantized": np.full((1, 12), 127, "i1"),
        "expression_scales": np.array([0.001], "<f4"),
    }
    sections, body = [], b""
    for name, array in arrays.items():
        section = {"name": name, "dtype": array.dtype.name, "shape": list(array.shape)}
        sections.append({**section, "offset": len(body), "byteLength": array.nbytes})
        body += array.tobytes() + bytes(-array.nbytes % 4)
    return {"meta": {"num_vertices": 4}, "sections": sections}, body


def test_a_file_of_the_public_description_is_read(tmp_path):
    header, body = small()
    path = tmp_path / "small.gnmw"
    path.write_bytes(file_bytes(header, body))
    model = gnmw.read(path)
    np.testing.assert_array_equal(model.vertices, np.arange(12).reshape(4, 3))
    np.testing.assert_array_equal(model.identity_basis[1], 0.25 * np.arange(0, 12).reshape(4, 3))
    np.testing.assert_allclose(model.expression_basis, np.full((1, 4, 3), 0.127), rtol=1e-6)
    gnmw.write(model, tmp_path / "again.gnmw")
    assert (tmp_path / "again.gnmw").read_bytes() == path.read_bytes()


def test_round_trip(tmp_path):
    model = gnmw.web_model(DATA)
    gnmw.write(model, tmp_path / "deep" / "a.gnmw")
    again = gnmw.read(tmp_path / "deep" / "a.gnmw")
    np.testing.assert_array_equal(again.vertices, DATA.template_vertex_positions)
    np.testing.assert_array_equal(again.triangles, DATA.triangles)
    for name, basis in (("identity", DATA.vertex_identity_basis), ("expression", DATA.expression_basis)):
        np.testing.assert_array_equal(getattr(again, f"{name}_basis"), getattr(model, f"{name}_basis"))
        largest = np.abs(basis.astype(float)).max((1, 2))
        error = np.abs(getattr(again, f"{name}_basis") - basis.astype(float)).max((1, 2))
        assert (error <= largest / 254 * (1 + 1e-5)).all()  # half a step of 1/127 of the largest value
        stated = gnmw.quantization_error(again, DATA)[name]
        exact = np.linalg.norm(getattr(again, f"{name}_basis") - basis.astype(float), axis=-1)
        assert stated.worst_mm == pytest.approx(1e3 * exact.max(), rel=1e-4)
        assert stated.rms_mm == pytest.approx(1e3 * np.sqrt((exact**2).mean()), rel=1e-4)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), exponent=st.integers(-30, 3), dtype=st.sampled_from([np.float16, np.float32]))
def test_any_basis_keeps_to_half_a_step(seed, exponent, dtype):
    rng = np.random.default_rng(seed)
    basis = (rng.normal(size=(3, *DATA.template_vertex_positions.shape)) * 10.0**exponent).astype(dtype)
    basis[1] = 0
    model = gnmw.web_model(replace(DATA, expression_basis=basis, expression_names=DATA.expression_names[:3]))
    largest = np.maximum(np.abs(basis.astype(float)).max((1, 2)), 127e-12)
    error = np.abs(model.expression_basis.astype(float) - basis.astype(float)).max((1, 2))
    assert (error <= largest / 254 * (1 + 1e-5)).all() and (model.expression_scales > 0).all()


def changed(name: str, /, **values: object):
    def change(header: dict) -> None:
        next(section for section in header["sections"] if section["name"] == name).update(values)

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h: h.update(sections=h["sections"][2:]), "missing: vertices, triangles"),
        (lambda h: h.update(sections={}), "a list of sections"),
        (lambda h: h.update(sections=[3]), "sections with names"),
        (lambda h: h.update(meta=[]), "an object `meta`"),
        (lambda h: h.update(meta={"num_vertices": 5}), "num_vertices 4"),
        (lambda h: h["sections"].append(h["sections"][0]), "names of their own"),
        (changed("vertices", name=""), "names of their own"),
        (changed("vertices", dtype="float64"), "section 'vertices'"),
        (changed("vertices", dtype="O"), "section 'vertices'"),
        (changed("vertices", shape=[3, 4]), "'vertices' has a wrong shape"),
        (changed("vertices", shape=[-4, -3]), "section 'vertices'"),
        (changed("vertices", shape=[4.0, 3]), "section 'vertices'"),
        (changed("vertices", shape=[True, 12]), "section 'vertices'"),
        (changed("vertices", shape=[2**62, 4]), "section 'vertices'"),
        (changed("vertices", offset=2), "section 'vertices'"),
        (changed("vertices", offset=10**6), "cut short"),
        (changed("vertices", byteLength=44), "section 'vertices'"),
        (changed("triangles", dtype="float32"), "'triangles' has a wrong type"),
        (changed("triangles", offset=0), "'triangles' has a wrong index"),
        (changed("identity_quantized", dtype="uint8"), "bases of 8 bits"),
        (changed("identity_quantized", shape=[24, 1]), "wrong shape"),
        (changed("identity_scales", offset=0), "scales above 0"),
    ],
)
def test_bad_headers_are_refused(tmp_path, change, message):
    header, body = small()
    change(header)
    path = tmp_path / "bad.gnmw"
    path.write_bytes(file_bytes(header, body))
    with pytest.raises(InputError) as caught:
        gnmw.read(path)
    assert message in str(caught.value) and caught.value.where == str(path)


WHOLE = file_bytes(*small())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "0 bytes"),
        (b"GNMW", "4 bytes"),
        (b"PK\x03\x04" + WHOLE[4:], "begins with GNMW"),
        (file_bytes(*small(), version=2), "version 2"),
        (struct.pack("<4sII", b"GNMW", 1, 2**32 - 4) + WHOLE[12:], "cut short"),
        (WHOLE[:-4], "cut short"),
        (struct.pack("<4sII", b"GNMW", 1, 8) + b"\xff" * 8, "UTF-8"),
        (struct.pack("<4sII", b"GNMW", 1, 8) + b"[1,2,3] ", "JSON object"),
        (struct.pack("<4sII", b"GNMW", 1, 8) + b'{"a":   ', "JSON"),
    ],
)
def test_damaged_files_are_refused(tmp_path, content, message):
    path = tmp_path / "bad.gnmw"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        gnmw.read(path)
    assert message in str(caught.value)


def test_values_that_are_not_finite_are_refused(tmp_path):
    header, body = small()
    path = tmp_path / "bad.gnmw"
    path.write_bytes(file_bytes(header, struct.pack("<f", np.nan) + body[4:]))
    with pytest.raises(InputError, match="'vertices' has a wrong value"):
        gnmw.read(path)


def test_other_sections_are_kept(tmp_path):
    header, body = small()
    section = {"name": "colours", "dtype": "uint8", "shape": [4], "offset": len(body), "byteLength": 4}
    header["sections"].append(section)
    path = tmp_path / "more.gnmw"
    path.write_bytes(file_bytes(header, body + b"\1\2\3\4"))
    model = gnmw.read(path)
    assert model.extra["colours"].tolist() == [1, 2, 3, 4]
    gnmw.write(model, tmp_path / "again.gnmw")
    assert gnmw.read(tmp_path / "again.gnmw").extra["colours"].tolist() == [1, 2, 3, 4]


def test_a_model_without_a_basis_is_refused():
    empty = replace(DATA, expression_basis=DATA.expression_basis[:0], expression_names=DATA.expression_names[:0])
    with pytest.raises(InputError, match="no expression components"):
        gnmw.web_model(empty)


@needs_shared
def test_the_full_head(tmp_path: Path):
    data = gnm_npz.read(SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz")
    gnmw.write(gnmw.web_model(data), tmp_path / "head.gnmw")
    assert (tmp_path / "head.gnmw").stat().st_size < 25e6
    errors = gnmw.quantization_error(gnmw.read(tmp_path / "head.gnmw"), data)
    print(errors)
    assert errors["identity"].rms_mm < 0.02 and errors["expression"].rms_mm < 0.01

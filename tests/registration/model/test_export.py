import numpy as np
import pytest

from registration.errors import InputError
from registration.model import gnm_npz, gnmw
from registration.model.export import export_model
from tests.fixtures.make_fixtures import HERE
from workflows.cli.app import main

TINY = HERE / "tiny_gnm.npz"


@pytest.fixture
def model(tmp_path):
    """A model with a field outside the schema."""
    path = tmp_path / "model.npz"
    with np.load(TINY) as archive:
        np.savez(path, **archive, rounds=np.arange(3))
    return path


def names(path) -> list[str]:
    with np.load(path) as archive:
        return archive.files


def test_npz_has_exactly_the_official_fields_unless_asked(model, tmp_path):
    out = tmp_path / "deep" / "out.npz"
    lines = export_model(model, out)
    assert names(out) == list(gnm_npz.AXES) and names(gnm_npz.extra_path(out)) == ["rounds"]
    assert str(gnm_npz.extra_path(out)) in lines[0] and "23 official fields, 1 others" in lines[0]
    export_model(model, out, extra_fields=True)
    assert names(out) == [*gnm_npz.AXES, "rounds"] and not gnm_npz.extra_path(out).exists()
    assert gnm_npz.content_hash(gnm_npz.read(out)) == gnm_npz.content_hash(gnm_npz.read(model))


def test_gnmw_says_what_it_costs_and_leaves_out(model, tmp_path, capsys):
    out = tmp_path / "out.gnmw"
    assert main(["model", "export", str(model), str(out)]) == 0
    text = capsys.readouterr().out
    data, web = gnm_npz.read(model), gnmw.read(out)
    worst = gnmw.quantization_error(web, data)["identity"].worst_mm
    assert f"identity: rounded by at most {worst:.4f} mm" in text and "left out: joints" in text
    assert main(["model", "info", str(out)]) == 0
    assert "8 bits a value" in capsys.readouterr().out
    assert main(["model", "info", str(out), "--out", str(tmp_path / "a.png")]) == 2
    assert main(["model", "info", str(out.rename(tmp_path / "b.npz"))]) == 2
    assert "a GNMW container" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("out", "extra", "what"),
    [
        ("model.glb", False, "format of the new file"),
        ("model", False, "format of the new file"),
        ("web.gnmw", True, "no extra fields"),
        ("model.npz", False, "replaced by its own copy"),
        ("folder.npz", False, "cannot be written"),
        ("model.npz/new.npz", False, "cannot be written"),
    ],
)
def test_bad_targets_are_refused(model, tmp_path, out, extra, what):
    (tmp_path / "folder.npz").mkdir()
    before = sorted(tmp_path.iterdir())
    with pytest.raises(InputError) as caught:
        export_model(model, tmp_path / out, extra_fields=extra)
    assert what in caught.value.what
    assert sorted(tmp_path.iterdir()) == before


def test_a_bad_model_is_refused_before_anything_is_written(tmp_path):
    (tmp_path / "model.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match="cannot be read"):
        export_model(tmp_path / "model.npz", tmp_path / "out.gnmw")
    assert not (tmp_path / "out.gnmw").exists()

"""The file of the auxiliary model."""

from dataclasses import replace

import numpy as np
import pytest

from registration.cranium import auxiliary_model as files
from registration.errors import InputError
from tests.registration.cranium.smooth_heads import auxiliary_model, tiny


def test_the_file_holds_the_model(tmp_path):
    model, file = auxiliary_model(), files.beside(tmp_path / "gnm_head.npz")
    assert files.find(tmp_path / "gnm_head.npz", tiny()) is None
    files.write(model, file)
    read = files.find(tmp_path / "gnm_head.npz", tiny())
    assert read is not None and (read.heads, read.seed, read.rank, read.source) == (40, 0, model.rank, "waves")
    np.testing.assert_allclose(read.basis, model.basis, atol=1e-7)
    np.testing.assert_allclose(read.mean, model.mean, atol=1e-7)
    assert read.noise == pytest.approx(model.noise)


def test_files_that_are_refused(tmp_path):
    model, data, file = auxiliary_model(), tiny(), tmp_path / "head_cranium.npz"
    for changed, word in (
        (replace(model, topology="0" * 64), "topology"),
        (replace(model, noise=0.0), "standard deviations"),
        (replace(model, mean=model.mean * np.nan), "wrong value"),
    ):
        files.write(changed, file)
        with pytest.raises(InputError, match=word):
            files.read(file, data)
    with np.load(FILE_OF_MODEL) as arrays:
        np.savez(file, **arrays)
    with pytest.raises(InputError, match="is missing"):
        files.read(file, data)


FILE_OF_MODEL = __file__.replace("registration/cranium/test_auxiliary_model.py", "fixtures/tiny_gnm.npz")

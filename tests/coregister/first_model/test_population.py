"""Sampled people in the identity basis: it represents spanned people and does not represent the others."""

from dataclasses import dataclass

import numpy as np
import pytest

from coregister.first_model.population import mean_person, sample_spanned_person, sample_unspanned_person, sliders

PEOPLE = 30
SEED = 7  # different from the basis'


def several(source, draw, count=PEOPLE, seed=SEED):
    rng = np.random.default_rng(seed)
    return [draw(source, rng) for _ in range(count)]


@pytest.mark.parametrize("draw", [sample_spanned_person, sample_unspanned_person, lambda source, rng: mean_person()])
def test_weights_refer_to_existing_targets(source, draw):
    for person in several(source, draw):
        assert set(person.weights) <= set(source.targets)
        weights = np.array(list(person.weights.values()))
        assert (weights >= 0).all() and (weights <= 1).all()
        for kind in ("universal", "african|asian|caucasian"):
            parts = [
                w
                for n, w in person.weights.items()
                if n.startswith(tuple(f"macrodetails/{k}" for k in kind.split("|")))
            ]
            assert sum(parts) == pytest.approx(1)


def test_equal_seeds_give_equal_people(source):
    for draw in (sample_spanned_person, sample_unspanned_person):
        assert several(source, draw, 3) == several(source, draw, 3)
        assert several(source, draw, 1) != several(source, draw, 1, seed=SEED + 1)
    assert mean_person() == mean_person()


def test_tags_describe_gender_age_and_ethnicity(source):
    model, unspanned = several(source, sample_spanned_person), several(source, sample_unspanned_person)
    for person in model + unspanned:
        assert set(person.tags) == {"gender", "age", "ethnicity"}
        assert person.tags["gender"] in ("female", "male")
        assert person.tags["ethnicity"] in ("african", "asian", "caucasian")
    assert {person.tags["age"] for person in model} == {25}
    ages = [person.tags["age"] for person in unspanned]
    assert 18 <= min(ages) < 40 and 60 < max(ages) < 90
    for key in ("gender", "ethnicity"):
        assert len({person.tags[key] for person in unspanned}) > 1
    for person in unspanned:  # an unspanned person has one gender, so no target of the other gender
        other = {"male": "female", "female": "male"}[person.tags["gender"]]
        assert not any(f"-{other}-" in name for name in person.weights)


def test_the_mean_person_weights_genders_and_ethnicities_equally_at_25():
    weights = mean_person().weights
    assert all("-young" in name for name in weights)
    gender_weights = {name: w for name, w in weights.items() if "universal" not in name}
    assert len(gender_weights) == 6 and set(np.round(list(gender_weights.values()), 12)) == {round(1 / 6, 12)}


def test_sliders_have_both_sides_and_no_repeated_target(source):
    all_sliders = sliders(source)
    names = [name for slider in all_sliders for name in slider.low + slider.high]
    assert len(names) == len(set(names)) and len(all_sliders) > 80
    assert all(slider.high for slider in all_sliders)
    assert {name.replace("/l-", "/r-") for name in names if "/l-" in name} <= set(names)
    by_high = {slider.high[0]: slider.low for slider in all_sliders}
    assert by_high["nose/nose-hump-incr"] == ("nose/nose-hump-decr",)
    assert not any(name.startswith(("head/head-trans", "mouth/mouth-trans-in")) for name in names)


def test_only_spanned_people_are_symmetric(source, head_assembly):
    def asymmetry(person):
        displacement = sum(weight * source.target(name) for name, weight in person.weights.items())
        return np.linalg.norm(
            (displacement - displacement[source.mirror] * (-1, 1, 1))[head_assembly.skin.base], axis=1
        ).max()

    model, other = (several(source, draw, 1)[0] for draw in (sample_spanned_person, sample_unspanned_person))
    assert asymmetry(model) < 1e-3 < 2e-3 < asymmetry(other)


@dataclass(frozen=True, kw_only=True)
class Projected:
    """Heads in the identity basis: S people, K components, V vertices; metres."""

    coefficients: np.ndarray  # (S, K)
    residual: np.ndarray  # (S, V), length of the residual
    size: np.ndarray  # (S, V), length of the displacement from the template


@pytest.fixture(scope="module")
def projected(source, head_assembly, model):
    populations = {"model": several(source, sample_spanned_person), "any": several(source, sample_unspanned_person)}
    names = sorted({name for heads in populations.values() for head in heads for name in head.weights})
    moves = {name: source.target(name) for name in names}
    rows = np.char.startswith(model.identity_names, "head")
    basis = model.vertex_identity_basis[rows].astype(np.float64).reshape(rows.sum(), -1)
    q, r = np.linalg.qr(basis.T)
    template = model.template_vertex_positions.astype(np.float64)

    def project(heads):
        delta = np.stack([head_assembly.assemble(head, moves)[0] - template for head in heads]).reshape(len(heads), -1)
        coefficients = np.linalg.solve(r, q.T @ delta.T).T
        residual = (delta - coefficients @ basis).reshape(len(heads), -1, 3)
        size = np.linalg.norm(delta.reshape(residual.shape), axis=2)
        return Projected(coefficients=coefficients, residual=np.linalg.norm(residual, axis=2), size=size)

    return {name: project(heads) for name, heads in populations.items()}


def rms(values):
    return float(np.sqrt((values**2).mean()))


def test_components_are_scaled_by_the_standard_deviation_of_the_people(projected):
    coefficients = projected["model"].coefficients
    leading = np.sqrt((coefficients[:, :10] ** 2).mean(0))
    print("rms of the leading coefficients", leading.round(2), "of all", rms(coefficients))
    assert 0.7 < rms(coefficients) < 1.3 and (leading > 0.6).all() and (leading < 1.5).all()
    assert np.abs(coefficients[:, :10].mean(0)).max() < 0.6  # with 30 people the standard deviation of the mean is 0.18


def test_components_are_ordered_by_displacement(model):
    rows = np.char.startswith(model.identity_names, "head")
    magnitudes = np.sqrt((model.vertex_identity_basis[rows].astype(np.float64) ** 2).sum((1, 2)))
    # The PCA included the joints, so components may be slightly out of order in the vertices alone.
    assert (magnitudes[1:] < 1.02 * magnitudes[:-1]).all()


def test_only_spanned_people_are_represented_by_the_basis(projected):
    model, other = projected["model"], projected["any"]
    for name, heads in projected.items():
        print(f"{name}: rms {1e3 * rms(heads.residual):.2f} mm of {1e3 * rms(heads.size):.2f}, ", end="")
        print(f"median {1e3 * np.median(heads.residual):.2f}, 95 % {1e3 * np.percentile(heads.residual, 95):.2f}")
    assert rms(model.residual) < 0.9e-3 and rms(model.residual) < 0.13 * rms(model.size)
    assert rms(other.residual) > 1.2e-3 and rms(other.residual) > 2 * rms(model.residual)
    assert np.sqrt((other.residual**2).mean(1)).min() > np.sqrt((model.residual**2).mean(1)).max()

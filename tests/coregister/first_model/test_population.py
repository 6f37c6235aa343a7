"""People, and what the identity basis makes of them: it holds model people and does not hold the others."""

from dataclasses import dataclass

import numpy as np
import pytest

from coregister.first_model.population import mean_person, sample_spanned_person, sample_unspanned_person, sliders

PEOPLE = 30
SEED = 7  # not the basis' own


def several(source, draw, count=PEOPLE, seed=SEED):
    rng = np.random.default_rng(seed)
    return [draw(source, rng) for _ in range(count)]


@pytest.mark.parametrize("draw", [sample_spanned_person, sample_unspanned_person, lambda source, rng: mean_person()])
def test_weights_are_of_targets_that_there_are(source, draw):
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


def test_equal_seeds_make_equal_people(source):
    for draw in (sample_spanned_person, sample_unspanned_person):
        assert several(source, draw, 3) == several(source, draw, 3)
        assert several(source, draw, 1) != several(source, draw, 1, seed=SEED + 1)
    assert mean_person() == mean_person()


def test_tags_tell_who_it_is(source):
    model, everyone = several(source, sample_spanned_person), several(source, sample_unspanned_person)
    for person in model + everyone:
        assert set(person.tags) == {"gender", "age", "ethnicity"}
        assert person.tags["gender"] in ("female", "male")
        assert person.tags["ethnicity"] in ("african", "asian", "caucasian")
    assert {person.tags["age"] for person in model} == {25}
    ages = [person.tags["age"] for person in everyone]
    assert 18 <= min(ages) < 40 and 60 < max(ages) < 90
    for key in ("gender", "ethnicity"):
        assert len({person.tags[key] for person in everyone}) > 1
    for person in everyone:  # an unspanned person has one gender, so no target of the other one
        other = {"male": "female", "female": "male"}[person.tags["gender"]]
        assert not any(f"-{other}-" in name for name in person.weights)


def test_the_mean_person_is_all_genders_and_ethnicities_alike_at_25():
    weights = mean_person().weights
    assert all("-young" in name for name in weights)
    share = {name: w for name, w in weights.items() if "universal" not in name}
    assert len(share) == 6 and set(np.round(list(share.values()), 12)) == {round(1 / 6, 12)}


def test_sliders_hold_both_sides_and_no_target_twice(source):
    found = sliders(source)
    names = [name for slider in found for name in slider.low + slider.high]
    assert len(names) == len(set(names)) and len(found) > 80
    assert all(slider.high for slider in found)
    assert {name.replace("/l-", "/r-") for name in names if "/l-" in name} <= set(names)
    by_high = {slider.high[0]: slider.low for slider in found}
    assert by_high["nose/nose-hump-incr"] == ("nose/nose-hump-decr",)
    assert not any(name.startswith(("head/head-trans", "mouth/mouth-trans-in")) for name in names)


def test_model_people_are_symmetric_and_others_are_not(source, head_assembly):
    def asymmetry(person):
        moved = sum(weight * source.target(name) for name, weight in person.weights.items())
        return np.linalg.norm((moved - moved[source.mirror] * (-1, 1, 1))[head_assembly.skin.base], axis=1).max()

    model, other = (several(source, draw, 1)[0] for draw in (sample_spanned_person, sample_unspanned_person))
    assert asymmetry(model) < 1e-3 < 2e-3 < asymmetry(other)


@dataclass(frozen=True, kw_only=True)
class Projected:
    """Heads as the basis has them: S people, K components, V vertices; metres."""

    coefficients: np.ndarray  # (S, K)
    residual: np.ndarray  # (S, V), length of what is left
    size: np.ndarray  # (S, V), length of the displacement from the template


@pytest.fixture(scope="module")
def projected(source, head_assembly, model):
    people = {"model": several(source, sample_spanned_person), "any": several(source, sample_unspanned_person)}
    names = sorted({name for heads in people.values() for head in heads for name in head.weights})
    moves = {name: source.target(name) for name in names}
    rows = np.char.startswith(model.identity_names, "head")
    basis = model.vertex_identity_basis[rows].astype(np.float64).reshape(rows.sum(), -1)
    q, r = np.linalg.qr(basis.T)
    template = model.template_vertex_positions.astype(np.float64)

    def project(heads):
        delta = np.stack([head_assembly.assemble(head, moves)[0] - template for head in heads]).reshape(len(heads), -1)
        coefficients = np.linalg.solve(r, q.T @ delta.T).T
        left = (delta - coefficients @ basis).reshape(len(heads), -1, 3)
        size = np.linalg.norm(delta.reshape(left.shape), axis=2)
        return Projected(coefficients=coefficients, residual=np.linalg.norm(left, axis=2), size=size)

    return {name: project(heads) for name, heads in people.items()}


def rms(values):
    return float(np.sqrt((values**2).mean()))


def test_components_are_scaled_by_the_people_s_own_deviation(projected):
    coefficients = projected["model"].coefficients
    leading = np.sqrt((coefficients[:, :10] ** 2).mean(0))
    print("rms of the leading coefficients", leading.round(2), "of all", rms(coefficients))
    assert 0.7 < rms(coefficients) < 1.3 and (leading > 0.6).all() and (leading < 1.5).all()
    assert np.abs(coefficients[:, :10].mean(0)).max() < 0.6  # with 30 people the mean's own deviation is 0.18


def test_components_come_in_order_of_what_they_move(model):
    rows = np.char.startswith(model.identity_names, "head")
    moved = np.sqrt((model.vertex_identity_basis[rows].astype(np.float64) ** 2).sum((1, 2)))
    # PCA was of vertices and joints together, so a component may be a little out of order in the vertices alone.
    assert (moved[1:] < 1.02 * moved[:-1]).all()


def test_model_people_are_spanned_and_others_are_not(projected):
    model, other = projected["model"], projected["any"]
    for name, one in projected.items():
        print(f"{name}: rms {1e3 * rms(one.residual):.2f} mm of {1e3 * rms(one.size):.2f}, ", end="")
        print(f"median {1e3 * np.median(one.residual):.2f}, 95 % {1e3 * np.percentile(one.residual, 95):.2f}")
    assert rms(model.residual) < 0.9e-3 and rms(model.residual) < 0.13 * rms(model.size)
    assert rms(other.residual) > 1.2e-3 and rms(other.residual) > 2 * rms(model.residual)
    assert np.sqrt((other.residual**2).mean(1)).min() > np.sqrt((model.residual**2).mean(1)).max()

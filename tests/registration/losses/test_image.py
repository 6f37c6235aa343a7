"""Image terms on a few pixels: values by hand, gradients by differences, and no effect where weights are zero."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from registration.losses import image
from registration.types import Camera, Pixels, Rendered, Targets

WIDTH, HEIGHT = 17, 15
CLASSES = ("skin", "left_eye", "mouth_interior")


def camera() -> Camera:
    return Camera(width_px=WIDTH, height_px=HEIGHT, intrinsics=np.eye(3), T_cam_world=np.eye(4))


def targets(pixels: Pixels | None = None, seed: int = 0) -> Targets:
    """Random values in every pixel, the subject everywhere, all weights 1."""
    pixels = pixels or Pixels.full([camera()])
    rng, count = torch.Generator().manual_seed(seed), len(pixels.view)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(count, *shape, generator=rng, dtype=torch.float64)

    ones = torch.ones(count, dtype=torch.float64)
    return Targets(
        names=("a",),
        class_names=CLASSES,
        pixels=pixels,
        rgb=0.1 + 0.8 * random(3),
        rgb_weight=ones,
        normals=torch.nn.functional.normalize(random(3) - 0.5, dim=1),
        normal_weight=ones,
        mask=ones,
        mask_weight=ones,
        classes=torch.nn.functional.normalize(random(3), p=1, dim=1),
        class_weight=ones,
        landmarks={},
        px_per_head=100.0,
    )


def same(target: Targets) -> Rendered:
    """A rendering equal to the targets."""
    return Rendered(rgb=target.rgb, normals=target.normals, classes=target.classes, mask=target.mask)


def everywhere(target: Targets) -> torch.Tensor:
    return torch.ones(len(target.mask), dtype=torch.bool)


TERMS = {
    "rgb": lambda r, t, agree: image.rgb_l1(r, t, agree),
    "ssim": lambda r, t, agree: image.rgb_ssim(r, t, agree),
    "normals": lambda r, t, agree: image.normals(r, t, agree, 2.5),
    "mask": lambda r, t, agree: image.mask(r, t),
    "classes": lambda r, t, agree: image.classes(r, t, torch.tensor([1.0, 4.0, 2.0], dtype=torch.float64)),
}
COMPARED = {"rgb": "rgb", "ssim": "rgb", "normals": "normals", "mask": "mask", "classes": "classes"}
WEIGHT = {"rgb": "rgb_weight", "ssim": "rgb_weight", "normals": "normal_weight"} | {
    "mask": "mask_weight",
    "classes": "class_weight",
}


@pytest.mark.parametrize("term", TERMS)
def test_only_equal_images_cost_nothing(term):
    target = targets()
    cost = TERMS[term](same(target), target, everywhere(target)).item()
    # The roots' rounding leaves a constant: 0.01 for each colour, 0.001 for a normal.
    assert cost == pytest.approx({"rgb": 0.03, "normals": 0.001}.get(term, 0.0), abs=1e-9)
    other = replace(same(target), **{COMPARED[term]: getattr(targets(seed=1), COMPARED[term]) * 0.5})
    assert TERMS[term](other, target, everywhere(target)).item() > cost + 0.05


@pytest.mark.parametrize("term", TERMS)
def test_gradients_against_differences(term):
    target = targets()
    start = getattr(same(targets(seed=1)), COMPARED[term])
    if term == "mask":
        start = start * 0.6

    def cost(values: torch.Tensor) -> torch.Tensor:
        return TERMS[term](replace(same(target), **{COMPARED[term]: values}), target, everywhere(target))

    assert torch.autograd.gradcheck(cost, start.clone().requires_grad_(), fast_mode=True)


@pytest.mark.parametrize("term", TERMS)
def test_values_without_weight_have_no_effect(term):
    """Neither on the value nor on any gradient, whatever the rendering and the targets are."""
    target = targets()
    hidden = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    hidden[4:9, 5:12] = True
    hidden = hidden.reshape(-1)
    target = replace(target, **{WEIGHT[term]: 1.0 - hidden.double()})
    rendered = same(targets(seed=1))

    def result(other_rendered: bool) -> tuple[float, torch.Tensor]:
        values = getattr(rendered, COMPARED[term]).clone()
        if other_rendered:
            values[hidden] = getattr(same(targets(seed=2)), COMPARED[term])[hidden] * 0.7
        values.requires_grad_()
        cost = TERMS[term](replace(rendered, **{COMPARED[term]: values}), target, everywhere(target))
        cost.backward()
        return cost.item(), values.grad

    cost, gradient = result(False)
    changed, changed_gradient = result(True)
    assert changed == pytest.approx(cost, rel=1e-12)
    torch.testing.assert_close(changed_gradient, gradient)
    assert gradient[hidden].abs().max() == 0


def test_rgb_by_hand():
    """A root of linear light, smoothed by 0.01; a mean over the subject's pixels, not over the listed ones."""
    target = targets()
    target = replace(target, rgb=torch.full_like(target.rgb, 0.25), mask=torch.zeros_like(target.mask))
    target.mask[:10], target.rgb_weight[:] = 1.0, 0.0
    target.rgb_weight[3] = 0.5
    rendered = replace(same(target), rgb=torch.full_like(target.rgb, 0.25))
    rendered.rgb[3] = torch.tensor([0.16, 0.25, -1.0])  # roots 0.4, 0.5, and 0.01 at the floor
    expected = 0.5 * (np.hypot(0.1, 0.01) + 0.01 + np.hypot(0.49, 0.01)) / 10
    assert image.rgb_l1(rendered, target, everywhere(target)).item() == pytest.approx(expected)
    assert image.rgb_l1(rendered, target, torch.zeros(len(target.mask), dtype=torch.bool)).item() == 0


def test_dark_pixels_have_finite_gradients():
    target = targets()
    dark = torch.zeros_like(target.rgb).requires_grad_()
    image.rgb_l1(replace(same(target), rgb=dark), target, everywhere(target)).backward()
    assert dark.grad.isfinite().all()


def test_normals_by_hand():
    target = targets()
    target = replace(
        target, normals=torch.zeros_like(target.normals), normal_weight=torch.zeros_like(target.normal_weight)
    )
    target.normals[:3] = torch.tensor([0.0, 0, 1])
    target.normal_weight[:3] = torch.tensor([1.0, 0.25, 1.0])
    rendered = replace(same(target), normals=torch.zeros_like(target.normals))
    rendered.normals[:3] = torch.tensor([[0, 0.6, 0.8], [0, 1, 0], [0, 0, -1]])
    lengths = np.sqrt(np.array([0.4, 2.0]) + 1e-6)  # squared: 0.36 + 0.04 and 1 + 1; the third is beyond 1.5
    value = image.normals(rendered, target, everywhere(target), 1.5).item()
    assert value == pytest.approx((lengths * [1, 0.25]).sum() / len(target.mask))
    two = image.normals(rendered, target, everywhere(target), 2.5).item()
    assert two == pytest.approx(((lengths * [1, 0.25]).sum() + np.sqrt(4 + 1e-6)) / len(target.mask))
    limits = torch.full_like(target.mask, 2.5)
    limits[1:3] = torch.tensor([1.0, 2.5])  # of each pixel: the second is beyond, the third is not
    each = image.normals(rendered, target, everywhere(target), limits).item()
    assert each == pytest.approx((lengths[0] + np.sqrt(4 + 1e-6)) / len(target.mask))


def test_mask_by_hand():
    """|x| beyond a quarter, x^2 within: the halves meet with one slope."""
    target = targets()
    target = replace(target, mask=torch.zeros_like(target.mask))
    target.mask[:5] = torch.tensor([1.0, 1, 1, 1, 0.5])
    rendered = replace(same(target), mask=target.mask.clone())
    rendered.mask[:4] = torch.tensor([0.0, 0.75, 0.9, 1.0])
    target.mask_weight[0] = 0.5
    expected = 0.5 * (1 - 0.125) + 0.125 + 0.01 / 0.5
    assert image.mask(rendered, target).item() == pytest.approx(expected / 4.5)


def test_classes_by_hand():
    """Each class has its weight; where the rendering misses the subject nothing is compared."""
    target = targets()
    target = replace(
        target, classes=torch.zeros_like(target.classes), class_weight=torch.zeros_like(target.class_weight)
    )
    target.classes[:2] = torch.tensor([1.0, 0, 0])
    target.class_weight[:2] = 1
    rendered = replace(same(target), classes=torch.zeros_like(target.classes), mask=torch.ones_like(target.mask))
    rendered.classes[0] = torch.tensor([0.0, 1.0, 0])
    rendered.mask[1] = 0.2
    weights = torch.tensor([1.0, 4.0, 1.0])
    assert image.classes(rendered, target, weights).item() == pytest.approx(0.875 * 5 / len(target.mask))


def test_eyes_and_lips_are_compared_only_where_classes_agree():
    """An eye on skin, or a miss, is not compared; half a lip or a soft border is."""
    pixels = Pixels.from_mask([camera()], torch.arange(HEIGHT * WIDTH).reshape(1, HEIGHT, WIDTH) < 5)
    target = targets(pixels)
    class_weights = [[1.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.4, 0.6, 0], [0, 0, 1]]
    rendered = [[1.0, 0, 0], [0, 1, 0], [0, 1, 0], [0.6, 0.4, 0], [0, 1, 0]]
    target = replace(target, classes=torch.tensor(class_weights, dtype=torch.float64))
    shown = replace(same(target), classes=torch.tensor(rendered, dtype=torch.float64))
    assert image.pixel_agreement(shown, target, [1, 2]).tolist() == [True, False, True, True, False]
    assert image.pixel_agreement(shown, target, []).all()
    missed = replace(shown, mask=torch.tensor([0.4, 1, 1, 1, 1], dtype=torch.float64))
    assert image.pixel_agreement(missed, target, [1, 2]).tolist() == [False, False, True, True, False]


def test_ssim_equals_skimages_with_a_window_of_eleven():
    """Against skimage's Gaussian SSIM in the centre of the image, where borders have no effect."""
    from skimage.metrics import structural_similarity

    target, other = targets(), targets(seed=1)
    middle = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.float64)
    middle[0, 7, 8] = 1
    target = replace(target, rgb_weight=target.pixels.of_image(middle))
    # Elsewhere the rendering would be replaced by the target: keep a tiny weight.
    target = replace(target, rgb_weight=target.rgb_weight.clamp_min(1e-12))
    value = image.rgb_ssim(same(other), target, everywhere(target)).item() * len(target.mask)
    a, b = (target.pixels.image(image.srgb_encoded(t.rgb))[0].numpy() for t in (other, target))
    _, full = structural_similarity(
        a,
        b,
        channel_axis=-1,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        truncate=5 / 1.5,
        use_sample_covariance=False,
        full=True,
    )
    assert value == pytest.approx(1 - full[7, 8].mean(), abs=1e-4)


def test_losses_do_not_depend_on_pixels_without_weight():
    """Terms do not depend on the number of listed pixels without weight."""
    chosen = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.bool)
    chosen[0, 3:12, 4:13] = True
    whole, rendered = targets(), same(targets(seed=1))
    index = whole.pixels.of_image(chosen)
    only = {name: values * index for name, values in vars(whole).items() if name.endswith("weight")}
    whole = replace(whole, mask=whole.mask * index, **only)
    shown = Pixels.from_mask([camera()], chosen)
    index = shown.of_image(whole.pixels.index)
    listed = {name: value[index] for name, value in vars(whole).items() if isinstance(value, torch.Tensor)}
    part = replace(whole, pixels=shown, **listed)
    cut = Rendered(**{name: value[index] for name, value in vars(rendered).items()})
    for name, term in TERMS.items():
        if name != "ssim":  # its windows see the background beyond the list
            agree = everywhere(whole)
            assert term(cut, part, agree[index]).item() == pytest.approx(term(rendered, whole, agree).item()), name

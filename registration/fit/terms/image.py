"""Terms that compare the rendering with the images, pixel by pixel (losses/image.py)."""

from collections.abc import Mapping

import torch
from torch import Tensor

from registration.fit.terms.term import StageContext, StepState, Term
from registration.losses import image
from registration.model.regions import offset_regions


def normals(context: StageContext) -> Term | None:
    """Rendered against predicted normals."""
    weights, fit = context.stage.weights, context.fit
    other, on_lids = weights.normal_truncation, weights.lid_normal_truncation
    lids = torch.as_tensor(offset_regions(fit.data)["lids"][fit.data.triangles].any(1), device=fit.device)

    def term(state: StepState) -> Mapping[str, Tensor]:
        truncation = state.batch.normal_weight.new_full(state.batch.normal_weight.shape, other)
        if on_lids != other:
            hits = fit.renderer.surface(state.vertices.detach(), state.batch.pixels)
            truncation[hits.pixel[lids[hits.face]]] = on_lids
        loss = image.normals(state.rendered, state.batch, state.agree, truncation)
        return {"normals": weights.normals * loss}

    return term if weights.normals > 0 else None


def mask(context: StageContext) -> Term | None:
    """Rendered against segmented silhouette."""
    weight = context.stage.weights.mask

    def term(state: StepState) -> Mapping[str, Tensor]:
        return {"mask": weight * image.mask(state.rendered, state.batch)}

    return term if weight > 0 else None


def classes(context: StageContext) -> Term | None:
    """Rendered against segmented classes; eyes count more."""
    weights = context.stage.weights
    names = context.fit.classes.names
    by_class = [weights.eye_classes if "eye" in name else 1.0 for name in names]
    class_weights = torch.tensor(by_class, device=context.fit.device)

    def term(state: StepState) -> Mapping[str, Tensor]:
        return {"classes": weights.classes * image.classes(state.rendered, state.batch, class_weights)}

    return term if weights.classes > 0 else None


def colour(context: StageContext) -> Term | None:
    """Colours of the texture, exposed as each camera's, against the images: L1 and SSIM."""
    weights = context.stage.weights

    def term(state: StepState) -> Mapping[str, Tensor]:
        exposed = context.appearance.apply_exposure(state.rendered, state.batch, state.views)
        losses = {"rgb": weights.rgb * image.rgb_l1(exposed, state.batch, state.agree)}
        if weights.ssim > 0:
            losses["ssim"] = weights.ssim * image.rgb_ssim(exposed, state.batch, state.agree)
        return losses

    return term if weights.rgb > 0 else None

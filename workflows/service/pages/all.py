"""The routes of all pages."""

from fastapi import APIRouter

from workflows.service.pages import capture, coregistration, files, gate, overview, wall

router = APIRouter(include_in_schema=False)
for module in (overview, wall, capture, files, coregistration, gate):
    router.include_router(module.router)

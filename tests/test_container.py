"""The image and the farm of compose.yaml, as far as they can be checked without a Docker daemon."""

import re
import tomllib

import yaml

from tests.conftest import ROOT

DOCKERFILE = (ROOT / "Dockerfile").read_text("utf-8")
COMPOSE = yaml.safe_load((ROOT / "compose.yaml").read_text("utf-8"))


def last_stage() -> str:
    return DOCKERFILE[DOCKERFILE.rindex("\nFROM ") :]


def test_every_foreign_image_is_pinned_by_digest():
    images = [COMPOSE["services"]["postgres"]["image"], *re.findall(r"^ARG DEBIAN=(\S+)", DOCKERFILE, re.M)]
    assert len(images) == 2
    assert [image for image in images if not re.search(r"@sha256:[0-9a-f]{64}$", image)] == []


def test_the_image_runs_as_a_user_without_rights_and_holds_no_tools_of_development():
    users = re.findall(r"^USER (\S+)", last_stage(), re.M)
    assert users and "root" not in users
    assert re.findall(r"\[(\w+)\]|optional-dependencies\"\]\[\"(\w+)\"\]", DOCKERFILE) == [("", "s3")]
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    assert {"mesh", "colmap", "dev"} < set(extras)


def test_dependencies_are_installed_before_the_source_is_copied():
    assert DOCKERFILE.index("--requirement requirements.txt") < DOCKERFILE.index("COPY registration ")
    copied = re.findall(r"^COPY (.+?) \S+$", DOCKERFILE, re.M)
    for name in " ".join(item for item in copied if "--from" not in item).split():
        assert (ROOT / name).exists()
    ignored = (ROOT / ".dockerignore").read_text("utf-8").split()
    assert {"build", ".venv", ".git"} <= set(ignored)


def test_the_password_is_in_no_url_and_only_this_machine_reaches_the_database():
    services = COMPOSE["services"]
    for name in ("coordinator", "worker", "serve", "gnmreg"):
        environment = services[name]["environment"]
        assert "PASSWORD" not in environment["GNMREG_DB"]
        assert "POSTGRES_PASSWORD" in environment["PGPASSWORD"]
    assert services["serve"]["ports"] == ["127.0.0.1:8080:8080"]
    assert services["postgres"]["ports"] == ["${GNMREG_DB_ADDRESS:-127.0.0.1}:5432:5432"]


def test_scaled_workers_share_the_cores():
    worker = COMPOSE["services"]["worker"]
    assert "GNMREG_THREADS" in worker["environment"]["OMP_NUM_THREADS"]
    assert "GNMREG_WORKERS" in worker["deploy"]["replicas"]

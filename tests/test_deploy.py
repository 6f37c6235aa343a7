"""Examples of deploy/: Kubernetes against its schema, the Slurm script with a Slurm environment, the Grafana dashboard.

None of them runs on a real cluster here.
"""

import json
import os
import re
import subprocess

import kubernetes_validate
import pytest
import yaml

from tests.conftest import ROOT
from workflows.cli.app import COMMANDS, main

DEPLOY = ROOT / "deploy"
OBJECTS = list(yaml.safe_load_all((DEPLOY / "kubernetes" / "gnmreg.yaml").read_text("utf-8")))
SCRIPT = DEPLOY / "slurm" / "workers.sbatch"


def containers():
    for item in OBJECTS:
        for container in item["spec"].get("template", {}).get("spec", {}).get("containers", ()):
            yield item, container


@pytest.mark.parametrize("item", OBJECTS, ids=lambda item: f"{item['kind']}-{item['metadata']['name']}")
def test_objects_of_kubernetes_are_valid(item):
    kubernetes_validate.validate(item, "1.32", strict=True)


def test_an_invalid_object_is_noticed():
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate({**OBJECTS[0], "spec": {"accessMode": []}}, "1.32", strict=True)


def test_pods_run_without_rights_and_without_a_token_of_the_cluster():
    for item, container in containers():
        spec = item["spec"]["template"]["spec"]
        assert spec["automountServiceAccountToken"] is False
        if container["image"].startswith("gnmreg"):
            assert (
                spec["securityContext"]["runAsNonRoot"] and not container["securityContext"]["allowPrivilegeEscalation"]
            )
            assert "PASSWORD" not in next(e["value"] for e in container["env"] if e["name"] == "GNMREG_DB")


def test_the_commands_of_pods_exist_and_take_their_options(capsys):
    for _, container in containers():
        if container["image"].startswith("gnmreg"):
            name, *words = container["args"]
            with pytest.raises(SystemExit) as stopped:
                main([name, *words, "--help"])
            assert stopped.value.code == 0 and name in COMMANDS
    capsys.readouterr()


@pytest.mark.parametrize("gpus, expected", [("3", " --gpu assigned"), ("", "")])
def test_the_script_of_slurm_starts_a_worker(tmp_path, gpus, expected):
    program = tmp_path / "gnmreg"
    program.write_text('#!/bin/bash\necho "$@"\n')
    program.chmod(0o755)
    environment = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "SLURM_JOB_ID": "71", "SLURM_JOB_GPUS": gpus}
    command = ["bash", str(SCRIPT), "/lab/farm", "/lab/data", "--queue", "rebuild"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == f"worker --folder /lab/farm --root /lab/data{expected} --queue rebuild"
    refused = subprocess.run(["bash", str(SCRIPT)], env=environment, capture_output=True, text=True, check=False)
    assert refused.returncode != 0 and "folder of the farm" in refused.stderr


def test_the_dashboard_asks_for_figures_that_exist():
    panels = json.loads((DEPLOY / "grafana" / "gnmreg.json").read_text("utf-8"))["panels"]
    asked = {name for panel in panels for t in panel["targets"] for name in re.findall(r"gnmreg_\w+", t["expr"])}
    source = (ROOT / "workflows" / "service" / "prometheus.py").read_text("utf-8")
    exported = set(re.findall(r'"(gnmreg_\w+)"', source))
    suffixes = ("_total", "_bucket", "_sum", "_count")
    plain = {next((name.removesuffix(s) for s in suffixes if name.removesuffix(s) in exported), name) for name in asked}
    assert plain == exported

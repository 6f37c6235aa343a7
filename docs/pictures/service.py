"""Takes the pictures of docs/service.md: `python -m docs.pictures.service REGISTRATIONS docs/service`.

REGISTRATIONS is a folder of subjects' folders of registrations. They are published as a batch would, in a queue whose
rows pretend the workers; more captures wait, run or have failed. Chromium is needed.
"""

import argparse
import json
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench.service import start
from bench.support import pretended_queue
from registration.report.pictures import jpeg
from registration.storage.hashing import to_jsonable
from registration.storage.registration_folder import is_registration, load_registration, read_manifest
from workflows.engine.client import QueueClient
from workflows.engine.database import default_url
from workflows.engine.jobs import DRIVER, FlowJob, Job
from workflows.engine.process import migrate
from workflows.pages.thumbnail import thumbnail
from workflows.records.headline import brief
from workflows.records.store import Store
from workflows.service.settings import ServiceSettings
from workflows.service.tokens import Tokens

RUN = "monday"
QUALITY, WIDE, NARROW = 82, (1200, 860), (400, 860)
MORE = 60  # captures without registration
FLAGS = ("--no-sandbox", "--disable-gpu")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("registrations", type=Path)
    parser.add_argument("out", type=Path)
    options = parser.parse_args()
    found = sorted(path for path in options.registrations.glob("*/*") if is_registration(path))
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="lab-") as name:
        folder = Path(name)
        url = default_url(folder)
        migrate(url)
        jobs = publish(url, folder, found)
        held = pretended_queue.pretend_workers(url, [*(f"lab-gpu{k}" for k in range(4)), "lab-coordinator0"])
        token = Tokens(ServiceSettings(url=url, folder=folder).state).create("Anna", ["operator", "reviewer"])
        process, port = start(url, folder)
        try:
            take(f"http://127.0.0.1:{port}", token, jobs, options.out)
        finally:
            process.terminate()
            process.wait()
        del held


def publish(url: str, folder: Path, found: list[Path]) -> list[str]:
    """Put the registrations, and further captures, into a store and a queue; return the ids of the registered ones."""
    out = folder / "results" / RUN
    pretended_queue.fill(url, out, RUN, MORE, shares=pretended_queue.Shares(done=0.0, failed=0.08, running=4))
    store, jobs, changes = Store(out), [], []
    for number, source in enumerate(found):
        key = f"{source.parent.name}/{source.name}"
        about = about_of(source)

        def make(attempt: Path, source: Path = source, about: dict[str, Any] = about) -> dict[str, Any]:
            shutil.copytree(source, attempt / "registration")
            image = thumbnail(load_registration(source))
            assert image is not None
            (attempt / "thumbnail.jpg").write_bytes(jpeg(image))
            return about

        artifact = store.produce(key, input_hash=key, make=make)
        arguments = {"capture": f"/data/captures/{key}", "store": str(out), "key": key, "options": {"recipe": "draft"}}
        jobs.append(Job(id=f"{RUN}/{key}", step="register_stored", arguments=arguments))
        end = time.time() - 240 * (len(found) - number)
        result = {**artifact.brief(), "attempt": artifact.attempt, "made": True}
        output = json.dumps({"status": "done", "reason": "", "seconds": about["seconds"], "result": result})
        times = {"started_at_epoch_ms": 1000 * (end - about["seconds"]), "completed_at": 1000 * end}
        row = {"id": jobs[-1].id, "status": "SUCCESS", "executor_id": f"lab-gpu{number % 4}", "output": output}
        changes.append({**row, **times, "error": None})
        log = folder / "logs" / f"{jobs[-1].id}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        log.write_text("".join(f"{name}: {seconds:.1f} s\n" for name, seconds in read_manifest(source).seconds.items()))
    client = QueueClient(url)
    client.submit([*jobs, FlowJob(id=RUN, flow="batch", queue=DRIVER)])
    client.close()
    pretended_queue.write(url, changes)
    return [job.id for job in jobs]


def about_of(source: Path) -> dict[str, Any]:
    """Return what the step that registers a capture reports."""
    manifest = read_manifest(source)
    seconds = sum(manifest.seconds.values())
    about = {"status": manifest.status, "reason": manifest.reason, "figures": brief(manifest.figures)}
    result: dict[str, Any] = to_jsonable({**about, "seconds": seconds, "thumbnail": True})
    return result


def take(base: str, token: str, jobs: list[str], out: Path) -> None:
    """Open the pages and write their pictures."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = shutil.which("chromium") or shutil.which("chromium-browser")
        browser = playwright.chromium.launch(executable_path=chromium, args=list(FLAGS))
        for scheme, size, pages in (
            ("light", WIDE, {"overview": "/", "run": f"/runs/{RUN}?status=converged", "gate": f"/gate/{RUN}"}),
            ("dark", WIDE, {"capture": f"/captures/{jobs[-1]}"}),
            ("light", NARROW, {"narrow": f"/runs/{RUN}"}),
        ):
            width, height = size
            context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
            tab = context.new_page()
            tab.goto(f"{base}/login")
            tab.fill("#token", token)
            tab.click("button")
            tab.wait_for_url(f"{base}/")
            for name, path in pages.items():
                tab.goto(base + path)
                tab.wait_for_timeout(2500)
                image = cv2.imdecode(np.frombuffer(tab.screenshot(), np.uint8), cv2.IMREAD_COLOR)
                cv2.imwrite(str(out / f"{name}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
            context.close()
        browser.close()


if __name__ == "__main__":
    main()

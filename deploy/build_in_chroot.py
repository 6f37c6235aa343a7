"""Run the steps of the Dockerfile without Docker: each stage is a folder that chroot enters.

    python deploy/build_in_chroot.py ROOTS [--arg NAME=VALUE ...] [--env NAME=VALUE ...] [--bind DIR ...]

For root on a machine with debootstrap. ROOTS/STAGE holds the file system of a stage; the last one's command is tried as
the image's user. What it cannot show: layers, the entry point of a container, GPUs.
"""

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SUITE, MIRROR = "trixie", "http://deb.debian.org/debian"  # of the base image
PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
_VARIABLE = re.compile(r"\$\{(\w+)\}|\$(\w+)")


class Stage:
    """A stage of the build, and the steps so far."""

    def __init__(self, folder: Path, environment: dict[str, str]) -> None:
        self.folder, self.environment = folder, {"PATH": PATH, **environment}
        self.workdir, self.user = "/", "root"

    def run(self, command: list[str], extra: dict[str, str] | None = None) -> None:
        """Execute a command in the stage. Raises CalledProcessError."""
        inside = f"cd {shlex.quote(self.workdir)} && exec {shlex.join(command)}"
        entry = ["chroot", f"--userspec={self.user}", str(self.folder), "/bin/sh", "-c", inside]
        subprocess.run(entry, env={**self.environment, **(extra or {})}, check=True)

    def place(self, name: str) -> Path:
        """The path, from outside, of a path in the stage."""
        return self.folder / os.path.join(self.workdir, name).lstrip("/")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("roots", type=Path)
    parser.add_argument("--arg", action="append", default=[], metavar="NAME=VALUE", help="build arguments")
    parser.add_argument("--env", action="append", default=[], metavar="NAME=VALUE", help="environment of all steps")
    parser.add_argument("--bind", action="append", default=[], metavar="DIR", help="folders that all steps see")
    options = parser.parse_args()
    try:
        return build(options)
    finally:
        for folder in options.roots.iterdir() if options.roots.is_dir() else ():
            unmount(folder, options.bind)


def build(options: argparse.Namespace) -> int:
    """Run all instructions of the Dockerfile."""
    given, extra = (dict(item.split("=", 1) for item in items) for items in (options.arg, options.env))
    arguments: dict[str, str] = {}
    stages: dict[str, Stage] = {}
    stage: Stage | None = None
    for word, rest in instructions((ROOT / "Dockerfile").read_text("utf-8")):
        print(f"{word} {rest[:100]}", flush=True)
        scope = {**arguments, **(stage.environment if stage else {})}
        if word == "ARG":
            name, _, default = rest.partition("=")
            arguments[name] = given.get(name, default)
        elif word == "FROM":
            source, _, name = rest.partition(" AS ")
            stage = new_stage(options.roots / (name or "image"), stages.get(source), extra, options.bind)
            stages[name or "image"] = stage
        elif stage is None:
            raise SystemExit(f"{word} before FROM")
        elif word == "ENV":
            for item in shlex.split(rest):
                name, _, value = item.partition("=")
                stage.environment[name] = expand(value, scope)
        elif word == "WORKDIR":
            stage.workdir = rest
            stage.place("").mkdir(parents=True, exist_ok=True)
        elif word == "USER":
            stage.user = rest
        elif word == "COPY":
            copy(stage, stages, shlex.split(rest))
        elif word == "RUN":
            stage.run(["/bin/sh", "-c", rest], arguments)
        elif word == "ENTRYPOINT":
            program = re.findall(r'"([^"]+)"', rest)
            stage.run([*program, "--version"])
            stage.run([*program, "serve", "--help"])
            subprocess.run(["chroot", f"--userspec={stage.user}", str(stage.folder), "id"], check=True)
    return 0


def instructions(text: str) -> list[tuple[str, str]]:
    """The instructions of a Dockerfile, with continued lines joined."""
    plain = "\n".join(line for line in text.splitlines() if not line.lstrip().startswith("#"))
    lines = re.sub(r"\\\n", "", plain).splitlines()
    return [(word, rest.strip()) for word, _, rest in (line.partition(" ") for line in lines) if word]


def new_stage(folder: Path, source: Stage | None, environment: dict[str, str], binds: list[str]) -> Stage:
    """A stage that begins as a copy of another one, or as the base system."""
    unmount(folder, binds)
    shutil.rmtree(folder, ignore_errors=True)
    if source is None:
        subprocess.run(["debootstrap", "--variant=minbase", SUITE, str(folder), MIRROR], check=True)
    else:
        subprocess.run(["cp", "-a", "--one-file-system", str(source.folder), str(folder)], check=True)
    shutil.copy("/etc/resolv.conf", folder / "etc" / "resolv.conf")
    subprocess.run(["mount", "-t", "proc", "proc", str(folder / "proc")], check=True)
    for bind in binds:
        inside = folder / bind.lstrip("/")
        inside.mkdir(parents=True, exist_ok=True)
        subprocess.run(["mount", "--bind", bind, str(inside)], check=True)
    stage = Stage(folder, environment)
    if source is not None:
        stage.environment.update(source.environment)
    return stage


def unmount(folder: Path, binds: list[str]) -> None:
    """Unmount what a stage sees of this machine; stop if that fails, as its files would be deleted with the stage."""
    for place in ("proc", *(bind.lstrip("/") for bind in binds)):
        if (folder / place).is_mount():
            subprocess.run(["umount", str(folder / place)], check=True)


def copy(stage: Stage, stages: dict[str, Stage], words: list[str]) -> None:
    """Execute COPY from the repository or from another stage."""
    sources = words[:-1]
    base = ROOT
    if sources[0].startswith("--from="):
        base, sources = stages[sources[0].partition("=")[2]].folder, sources[1:]
    for name in sources:
        source, target = base / name.lstrip("/"), stage.place(words[-1])
        if source.is_dir():
            shutil.copytree(source, target, dirs_exist_ok=True, symlinks=True)
        else:
            shutil.copy(source, target / source.name if words[-1].endswith("/") else target)


def expand(text: str, scope: dict[str, str]) -> str:
    """Replace $NAME and ${NAME}."""
    return _VARIABLE.sub(lambda match: scope.get(match[1] or match[2], ""), text)


if __name__ == "__main__":
    sys.exit(main())

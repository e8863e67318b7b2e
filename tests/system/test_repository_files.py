"""Files beside the package that other programs read: workflows, the action, the container image."""

import json
import re
import shutil
import sys
from pathlib import Path

import pytest
import yaml

from fleet_slip.cli.app import load_command
from tests.support.commands import COMMAND, Finished, run

CHECKOUT = Path(__file__).parents[2]
WORKFLOWS = sorted((CHECKOUT / ".github/workflows").glob("*.yml"))


def load(name: str) -> dict[str, object]:
    content = yaml.safe_load((CHECKOUT / name).read_text())
    assert isinstance(content, dict)
    return content


@pytest.mark.tools("actionlint")
@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_satisfies_actionlint(workflow: Path) -> None:
    done = run(["actionlint", str(workflow)])
    assert (done.exit_code, done.stdout) == (0, "")


@pytest.mark.tools("zizmor")
def test_workflows_and_the_action_satisfy_zizmor() -> None:
    places = [str(CHECKOUT / ".github/workflows"), str(CHECKOUT / "action.yml")]
    done = run(["zizmor", "--offline", "--no-progress", *places])
    assert done.exit_code == 0, done.stdout + done.stderr


def test_the_tests_run_on_the_versions_that_the_package_names() -> None:
    text = (CHECKOUT / ".github/workflows/test.yml").read_text()
    versions = yaml.safe_load(text)["jobs"]["test"]["strategy"]["matrix"]["python"]
    project = (CHECKOUT / "pyproject.toml").read_text()
    assert versions == ["3.11", "3.12", "3.13", "3.14"]
    for version in versions:
        assert f"Programming Language :: Python :: {version}" in project


def test_every_action_is_pinned_by_a_digest() -> None:
    for workflow in WORKFLOWS:
        for job in yaml.safe_load(workflow.read_text())["jobs"].values():
            for step in job["steps"]:
                _, _, version = step.get("uses", "@" + "0" * 40).partition("@")
                assert len(version) == 40, step


def test_citation_and_package_have_one_version() -> None:
    project = (CHECKOUT / "pyproject.toml").read_text()
    assert f'\nversion = "{load("CITATION.cff")["version"]}"\n' in project


@pytest.mark.tools("cyclonedx-py")
def test_the_components_of_a_release_are_the_pinned_packages(tmp_path: Path) -> None:
    """The command of the workflow."""
    options = ["--pyproject", "pyproject.toml", "--output-reproducible", "--spec-version", "1.6"]
    file = tmp_path / "sbom.json"
    command = ["cyclonedx-py", "requirements", *options, "--output-file", str(file)]
    done = run([*command, "constraints.txt"], cwd=CHECKOUT)
    assert done.exit_code == 0, done.stderr
    document = json.loads(file.read_text())
    lines = (CHECKOUT / "constraints.txt").read_text().splitlines()
    pins = {line.partition(";")[0].strip() for line in lines if "==" in line}
    components = {f"{c['name']}=={c['version']}" for c in document["components"]}
    assert components == pins
    assert document["metadata"]["component"]["name"] == "fleet-slip"


# The image. Its steps run in a folder here, and in a builder where there is one.

MAX_IMAGE_BYTES = 1.2e9
BASE_IMAGE_BYTES = 1.4e8
"""Size of python:3.12-slim-bookworm, rounded up."""


@pytest.mark.tools("hadolint")
def test_the_containerfile_satisfies_hadolint() -> None:
    done = run(["hadolint", str(CHECKOUT / "Containerfile")])
    assert (done.exit_code, done.stdout) == (0, "")


@pytest.mark.long
def test_the_steps_of_the_containerfile_give_a_program_of_the_allowed_size(tmp_path: Path) -> None:
    text = (CHECKOUT / "Containerfile").read_text()
    source, target = tmp_path / "source", tmp_path / "fleet-slip"
    for name in [
        word for line in re.findall(r"^COPY ([^-].*) \S+$", text, re.M) for word in line.split()
    ]:
        place = source / name
        place.parent.mkdir(parents=True, exist_ok=True)
        copy = shutil.copytree if (CHECKOUT / name).is_dir() else shutil.copy
        copy(CHECKOUT / name, place)
    installs = [step for step in re.findall(r"^RUN ((?:.*\\\n)*.*)", text, re.M) if "pip" in step]
    assert len(installs) == 2
    for step in [*installs, "trim /opt/fleet-slip"]:
        command = step.replace("/opt/fleet-slip", str(target)).replace("\\\n", " ")
        command = command.replace("python -m venv", f"{sys.executable} -m venv")
        command = command.replace("trim ", f"{CHECKOUT / '.github/trim-environment'} ")
        done = run(["sh", "-c", command], cwd=source)
        assert done.exit_code == 0, done.stderr
    size = sum(file.lstat().st_size for file in target.rglob("*"))
    assert size + BASE_IMAGE_BYTES < MAX_IMAGE_BYTES
    demo = run(
        [str(target / "bin/fleet-slip"), "demo"],
        cwd=tmp_path,
        env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
    )
    assert demo.exit_code == 0, demo.stderr


# The gate of the action, as a pull request runs it, without the evaluation, which takes minutes.


def gate(root: Path, folder: Path, **variables: str) -> tuple[Finished, dict[str, str]]:
    """Run the gate on a data root; return it, and the outputs of the step."""
    program = folder / "program"
    program.write_text(
        f'#!/bin/sh\ncase "$*" in *evaluate*) echo {{}};; *) "{COMMAND}" "$@";; esac'
    )
    program.chmod(0o755)
    outputs = folder / "outputs"
    environment = {
        "PATH": "/usr/bin:/bin",
        "HOME": str(folder),
        "NUMBA_CACHE_DIR": str(folder / "cache"),
        "PROGRAM": str(program),
        "ROOT": str(root),
        "MODEL": "smoke",
        "WORK": str(folder / "work"),
        "GITHUB_OUTPUT": str(outputs),
        **variables,
    }
    done = run([str(CHECKOUT / ".github/gate")], env=environment, cwd=folder)
    return done, dict(line.split("=", 1) for line in outputs.read_text().splitlines())


@pytest.mark.long
def test_the_gate_refuses_a_worse_model_list_and_leaves_the_data_root(
    smoke_root: Path, tmp_path: Path
) -> None:
    worse = tmp_path / "worse.toml"
    worse.write_text(
        'description = "Speed of one wheel"\n[folds]\nby = "drive"\ncount = 5\n'
        '[[model]]\nname = "1"\nsignals = ["wheel_fl"]\n'
    )
    refused, outputs = gate(smoke_root, tmp_path, MODELS=str(worse))
    assert refused.exit_code == 7, refused.stderr
    assert "Refused: the model would be worse than the champion." in refused.stdout
    assert Path(outputs["report"]).read_text() == "{}\n"
    assert run([COMMAND, "--root", str(smoke_root), "show", "smoke@2"]).exit_code == 5


@pytest.mark.long
def test_the_gate_passes_a_model_list_that_is_as_good(smoke_root: Path, tmp_path: Path) -> None:
    list_path = shutil.copy(CHECKOUT / "configs/models/estimator.toml", tmp_path / "own.toml")
    passed, outputs = gate(smoke_root, tmp_path, MODELS=str(list_path))
    assert passed.exit_code == 0, passed.stderr
    assert json.loads(Path(outputs["decision"]).read_text())


def test_the_examples_of_the_operations_page_are_documents_with_commands_that_exist() -> None:
    text = (CHECKOUT / "docs/operations.md").read_text()
    compose, job, workflow = map(yaml.safe_load, re.findall(r"```yaml\n(.*?)```", text, re.S))
    container = job["spec"]["jobTemplate"]["spec"]["template"]["spec"]["containers"][0]
    for words in (compose["services"]["night"]["command"], container["args"]):
        load_command(words[0]).make_context(words[0], words[1:]).close()
    action = load("action.yml")["inputs"]
    assert isinstance(action, dict)
    assert workflow["jobs"]["gate"]["steps"][1]["with"].keys() <= action.keys()


@pytest.mark.long
def test_the_image_runs_as_a_user_without_rights(tmp_path: Path) -> None:
    builder = next(filter(shutil.which, ("podman", "docker")), None)
    if builder is None or run([builder, "info"]).exit_code:
        pytest.skip("no builder of images runs on this machine")
    base = re.findall(r"^FROM (\S+:\S+) AS", (CHECKOUT / "Containerfile").read_text(), re.M)[0]
    if run([builder, "pull", base]).exit_code:
        pytest.skip(f"{base} cannot be pulled")
    build = [builder, "build", "--file", "Containerfile", "--target", "slim", "--tag"]
    built = run([*build, "fleet-slip:test", "."], cwd=CHECKOUT, patience_s=1800)
    assert built.exit_code == 0, built.stderr
    size = run([builder, "image", "inspect", "--format", "{{.Size}}", "fleet-slip:test"])
    assert int(size.stdout) < MAX_IMAGE_BYTES
    shell = [builder, "run", "--rm", "--entrypoint", "sh", "fleet-slip:test", "-c"]
    done = run([*shell, "id --user && fleet-slip run --campaign smoke && fleet-slip status"])
    assert done.exit_code == 0, done.stderr
    assert done.stdout.startswith("10001\n")

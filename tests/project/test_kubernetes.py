"""The fleet on Kubernetes: each object follows its schema, and all of them the settings and habits of the house."""

from __future__ import annotations

import copy
import re
import shutil
import subprocess
from typing import Any

import kubernetes_validate
import pytest
import typer
import yaml
from cloudcoil.models.keda.v1alpha1 import ScaledJob
from kubernetes_objects import FOLDER, KUSTOMIZATION, counted, objects, pod_templates, scaled_jobs

from advtex_server.app import create_app
from advtex_server.main import app as server_command
from advtex_server.settings import ServerSettings
from advtex_store.settings import StoreSettings
from advtex_worker.main import argument_parser
from advtex_worker.settings import WorkerSettings

RELEASES = ("1.32", "1.37")  # of Kubernetes
SETTINGS: dict[str, type[StoreSettings]] = {"worker": WorkerSettings}
UID = 10001
PODS = [pytest.param(component, template["spec"], id=component) for component, template in pod_templates()]


def name_of(found: dict[str, Any]) -> str:
    return f"{found['kind']}-{found['metadata']['name']}"


def check(found: dict[str, Any]) -> None:
    """Against the schemas of Kubernetes and KEDA; fields that they do not know are errors."""
    if found["kind"] != "ScaledJob":
        for release in RELEASES:
            kubernetes_validate.validate(found, release, strict=True)
        return
    target = found["spec"]["jobTargetRef"]
    job = {"apiVersion": "batch/v1", "kind": "Job", "metadata": {"name": "any"}, "spec": target}
    for release in RELEASES:
        kubernetes_validate.validate(job, release, strict=True)
    bare = copy.deepcopy(found)
    bare["spec"]["jobTargetRef"]["template"] = {"spec": {"containers": []}}  # is Kubernetes' own
    read = ScaledJob.model_validate(bare)
    assert read.model_dump(mode="json", by_alias=True, exclude_unset=True) == bare, "KEDA knows no such field"


def test_every_file_is_applied() -> None:
    assert sorted(KUSTOMIZATION["resources"]) == sorted(
        path.name for path in FOLDER.iterdir() if path.name != "kustomization.yaml"
    )


@pytest.mark.parametrize("found", objects(), ids=name_of)
def test_every_object_follows_its_schema(found: dict[str, Any]) -> None:
    check(found)


@pytest.mark.parametrize("found", [scaled_jobs()[0], *objects()[-1:]], ids=name_of)
def test_a_field_that_is_misspelled_or_of_another_type_is_seen(found: dict[str, Any]) -> None:
    for wrong in ({"podSelectors": {}, "pollingIntervals": 3}, {"podSelector": 3, "pollingInterval": "soon"}):
        with pytest.raises((kubernetes_validate.ValidationError, ValueError, AssertionError)):
            check(found | {"spec": found["spec"] | wrong})


@pytest.mark.skipif(shutil.which("kubectl") is None, reason="no kubectl")
def test_it_is_what_kustomize_makes_of_it() -> None:
    done = subprocess.run(["kubectl", "kustomize", str(FOLDER)], capture_output=True, text=True, check=True)
    made = {name_of(found): found for found in yaml.safe_load_all(done.stdout)}
    assert set(made) == {name_of(found) for found in objects()}
    for found in made.values():
        check(found)
        assert found["metadata"].get("namespace", "advtex") == "advtex"
    tags = {image["name"]: image["newTag"] for image in KUSTOMIZATION["images"]}
    used = set(re.findall(r"image: (\S+)", done.stdout))
    assert used == {f"{name}:{tag}" for name, tag in tags.items()}


@pytest.mark.parametrize(("component", "pod"), PODS)
def test_settings_are_read_by_whom_they_are_given_to(component: str, pod: dict[str, Any]) -> None:
    known = SETTINGS.get(component, ServerSettings).model_fields
    (container,) = pod["containers"]
    assert container["envFrom"] == [{"configMapRef": {"name": "advtex"}}, {"secretRef": {"name": "advtex"}}]
    (shared,) = [found["data"] for found in objects() if found["kind"] == "ConfigMap"]
    given = {entry["name"]: entry["value"] for entry in container.get("env", [])}
    told = {name.removeprefix("ADVTEX_").lower() for name in shared | given if name.startswith("ADVTEX_")}
    assert told <= set(known)
    assert not any(re.search(r"SECRET|PASSWORD|KEY|TOKEN", name) for name in shared | given)
    assert not any(found["kind"] == "Secret" for found in objects())


@pytest.mark.parametrize(("component", "pod"), PODS)
def test_arguments_are_known(component: str, pod: dict[str, Any]) -> None:
    arguments = pod["containers"][0]["args"]
    if component == "worker":
        argument_parser().parse_args(arguments)
        return
    command = typer.main.get_command(server_command).commands[arguments[0]]  # type: ignore[attr-defined]
    command.make_context(arguments[0], arguments[1:]).close()


@pytest.mark.parametrize(("component", "pod"), PODS)
def test_pods_may_do_nothing_that_they_need_not(component: str, pod: dict[str, Any]) -> None:
    assert pod["automountServiceAccountToken"] is False
    assert pod["securityContext"]["runAsNonRoot"] is True
    assert pod["securityContext"]["runAsUser"] == UID
    assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    (container,) = pod["containers"]
    assert container["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }
    assert {"cpu", "memory"} <= set(container["resources"]["requests"])
    assert "memory" in container["resources"]["limits"]
    mounts = {mount["name"]: mount["mountPath"] for mount in container["volumeMounts"]}
    assert mounts == {"data": "/var/lib/advtex", "tmp": "/tmp"}, "nothing else can be written to"
    assert {volume["name"] for volume in pod["volumes"] if "emptyDir" in volume} == set(mounts)


def named(kind: str, name: str) -> dict[str, Any]:
    (found,) = [found for found in objects() if (found["kind"], found["metadata"]["name"]) == (kind, name)]
    return found


def test_probes_ask_what_the_server_answers() -> None:
    (container,) = named("Deployment", "server")["spec"]["template"]["spec"]["containers"]
    probes = {kind: container[f"{kind}Probe"]["httpGet"] for kind in ("startup", "liveness", "readiness")}
    paths = {kind: probe["path"] for kind, probe in probes.items()}
    assert paths == {"startup": "/healthz", "liveness": "/healthz", "readiness": "/readyz"}
    assert set(paths.values()) | {"/metrics"} <= set(create_app(ServerSettings()).openapi()["paths"])
    (port,) = container["ports"]
    assert {probe["port"] for probe in probes.values()} == {port["name"]}
    assert str(port["containerPort"]) in container["args"]
    annotations = named("Deployment", "server")["spec"]["template"]["metadata"]["annotations"]
    assert annotations["prometheus.io/port"] == str(port["containerPort"])


@pytest.mark.parametrize(("component", "pod"), PODS)
def test_there_is_time_to_end(component: str, pod: dict[str, Any]) -> None:
    (container,) = pod["containers"]
    given = {entry["name"]: entry["value"] for entry in container.get("env", [])}
    if component == "worker":
        assert pod["terminationGracePeriodSeconds"] > 2 * float(given["ADVTEX_GRACE_SECONDS"])
    elif component == "server":
        pause = float(container["lifecycle"]["preStop"]["exec"]["command"][1])
        assert pod["terminationGracePeriodSeconds"] > pause + float(given["ADVTEX_SHUTDOWN_SECONDS"])


def test_selectors_find_the_pods_that_are_meant() -> None:
    labels = {component: template["metadata"]["labels"] for component, template in pod_templates()}

    def found_by(selector: dict[str, str]) -> set[str]:
        return {component for component, given in labels.items() if selector.items() <= given.items()}

    for kind in ("Deployment", "PodDisruptionBudget"):
        for name in ("server", "dispatcher"):
            assert found_by(named(kind, name)["spec"]["selector"]["matchLabels"]) == {name}
            assert (
                named("Deployment", name)["spec"]["replicas"]
                > named("PodDisruptionBudget", name)["spec"]["maxUnavailable"]
            )
    assert found_by(named("Service", "server")["spec"]["selector"]) == {"server"}
    assert named("NetworkPolicy", "nothing-else")["spec"] == {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}
    inwards = named("NetworkPolicy", "to-the-server")["spec"]
    assert found_by(inwards["podSelector"]["matchLabels"]) == {"server"}
    assert [rule["ports"] for rule in inwards["ingress"]] == [[{"port": "http"}]]
    outwards = named("NetworkPolicy", "to-what-it-needs")["spec"]
    assert found_by(outwards["podSelector"]["matchLabels"]) == set(labels)


def test_every_job_is_of_one_class_and_its_nodes_can_take_it() -> None:
    classes = {}
    for found in scaled_jobs():
        (waiting, busy) = counted(found)
        assert waiting[:2] == ("advtex_jobs_waiting", "memory_gib")
        assert busy[:2] == ("advtex_workers_busy", "gib")
        assert waiting[2] == busy[2]
        takes = [gib for gib in range(1000) if waiting[2].fullmatch(str(gib))]
        assert takes == list(range(takes[0], takes[-1] + 1))
        pod = found["spec"]["jobTargetRef"]["template"]["spec"]
        (term,) = pod["affinity"]["nodeAffinity"]["requiredDuringSchedulingIgnoredDuringExecution"]["nodeSelectorTerms"]
        bounds = {entry["operator"]: int(entry["values"][0]) for entry in term["matchExpressions"]}
        assert (bounds["Gt"] + 1) // 1024 == takes[-1], "the smallest GPU takes the largest job"
        classes[found["metadata"]["name"]] = (takes, bounds)
    small, large = classes.values()
    assert small[0][0] == 0
    assert large[0][0] == small[0][-1] + 1
    assert small[1]["Lt"] == large[1]["Gt"] + 1


def test_workers_end_by_themselves_and_outlive_a_change_of_the_settings() -> None:
    for found in scaled_jobs():
        spec = found["spec"]
        (container,) = spec["jobTargetRef"]["template"]["spec"]["containers"]
        assert container["args"][0] == "--exit-when-idle"
        assert float(container["args"][1]) > 4 * spec["pollingInterval"], "a job's end is seen before its worker's"
        assert spec["rollout"] == {"strategy": "gradual"}
        assert spec.get("minReplicaCount", 0) == 0
        assert container["resources"]["limits"]["nvidia.com/gpu"] == "1"

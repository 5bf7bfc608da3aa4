"""Other programs read what is in docker: hadolint the Dockerfile, the API server's own schemas
(kubernetes-validate, strictly) the manifests and what Helm itself renders of the chart, models made
from the Prometheus Operator's definitions the ServiceMonitor. The chart with its own values must
be the manifests.

python3 judge_containers.py
"""

import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path

import helm_python as helm
import kubernetes_validate
import yaml
from cloudcoil.models.prometheus_operator.v1 import ServiceMonitor

docker = Path(__file__).parents[2] / "docker"
chart = helm.Chart.load(str(docker / "chart"))
faults: list[str] = []

# Values that people set, and how many objects come of them: with the chart's own it is five.
USES: list[tuple[dict, int]] = [
    ({"gpu": {"enabled": True, "runtimeClassName": "nvidia"}, "image": {"tag": "gpu"}}, 5),
    ({"autoscaling": {"enabled": False}, "networkPolicy": {"enabled": False}}, 3),
    ({"image": {"digest": "sha256:" + 64 * "0", "pullSecrets": ["registry"]}}, 5),
    ({"env": {"SEGSPLAT_JOBS": 2, "SEGSPLAT_OTLP": "http://collector:4318"}}, 5),
    ({"nodeSelector": {"disk": "ssd"}, "tolerations": [{"operator": "Exists"}]}, 5),
    ({"service": {"type": "LoadBalancer", "port": 8080}}, 5),
]
# Values that are refused, and the word that the refusal has.
REFUSED: list[tuple[dict, str]] = [
    ({"replcas": 3}, "replcas"),
    ({"store": "/data"}, "store"),
    ({"image": {"digest": "sha256:0"}}, "digest"),
    ({"autoscaling": {"min": 0}}, "min"),
    ({"networkPolicy": {"egressPorts": [70000]}}, "egressPorts"),
    ({"env": {"no name": "x"}}, "no name"),
]


def check(is_so: bool, what: str) -> None:
    """Notes what is not so."""
    if not is_so:
        faults.append(what)


def manifests(name: str) -> list[dict]:
    """The objects of a file."""
    return list(yaml.safe_load_all((docker / "kubernetes" / name).read_text()))


def rendered(values: dict, name: str = "segsplat") -> list[dict]:
    """The objects that Helm makes, in the order of the templates."""
    files = chart.render(values, name=name, namespace="default")
    objects = (yaml.safe_load_all(text) for _, text in sorted(files.items(), reverse=True))
    return [found for of_file in objects for found in of_file if found]


def judged(objects: list[dict], whence: str) -> Iterator[str]:
    """What is wrong with objects."""
    for found in objects:
        kind = f"{whence}: {found['kind']}"
        if found["kind"] == "ServiceMonitor":
            read = ServiceMonitor.model_validate(found)
            kept = read.model_dump(by_alias=True, exclude_unset=True, mode="json")
            spec = found["spec"]
            if kept["spec"] != spec:
                yield f"{kind}: the operator reads {kept['spec']} of {spec}"
            continue
        try:
            kubernetes_validate.validate(found, "1.37", strict=True)
        except (kubernetes_validate.ValidationError, ValueError) as refused:
            yield f"{kind}: {refused}"


lint = Path(sysconfig.get_path("scripts")) / "hadolint"
# The security updates of the base are wanted, so versions of Debian's packages are not pinned.
told = subprocess.run([lint, "--ignore", "DL3008", docker / "Dockerfile"], text=True,
                      stdout=subprocess.PIPE)
check(told.returncode == 0 and not told.stdout, f"hadolint: {told.stdout}")

core, monitor = manifests("segsplat.yaml"), manifests("monitor.yaml")
faults += judged(core + monitor, "docker/kubernetes")
for values, want in (({}, core), ({"serviceMonitor": {"enabled": True}}, core + monitor)):
    got = rendered(values)
    for mine, other in zip(want, got):
        check(mine == other, f"the chart makes {other}\nof the manifest's {mine}")
    check(len(want) == len(got), f"the chart makes {len(got)} objects, the manifests {len(want)}")
for values, count in USES:
    got = rendered(values)
    faults += judged(got, f"chart with {values}")
    check(len(got) == count, f"chart with {values}: {[found['kind'] for found in got]}")
gpu, other = rendered(USES[0][0])[0], rendered({}, "other")
limits = gpu["spec"]["template"]["spec"]["containers"][0]["resources"]["limits"]
check(limits == {"nvidia.com/gpu": 1, "memory": "8Gi"}, f"limits with a GPU: {limits}")
names = {found["metadata"]["name"] for found in other}
check(names == {"other"}, f"a release called other has objects called {names}")
for values, word in REFUSED:
    try:
        rendered(values)
        check(False, f"the chart takes {values}")
    except helm.HelmValuesError as refused:
        check(word in str(refused), f"{values}: the refusal does not name {word}: {refused}")
said = helm.lint(str(docker / "chart"))
check(not said["errors"], f"helm lint: {said}")

for fault in faults:
    print(f"FAILED {fault}")
print(f"containers: hadolint, {len(core + monitor)} manifests by the schemas of Kubernetes 1.37, "
      f"{2 + len(USES)} renderings by Helm {helm.helm_sdk_version()}, "
      f"{len(REFUSED)} values refused, {len(faults)} faults")
sys.exit(bool(faults))

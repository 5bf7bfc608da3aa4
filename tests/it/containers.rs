//! Images, compose and manifests, as far as they can be held to the program without an engine:
//! what they copy exists, what they set is known, what they ask is served; and the program works
//! as they run it. `scripts/image` builds and runs them.

use std::{
    collections::BTreeSet,
    fs,
    os::unix::fs::{PermissionsExt, symlink},
    path::Path,
    process::Command,
};

use segsplat::{
    api::http::routes,
    error::TABLE,
    sample::{self, SampleOptions},
};
use serde_json::Value;

use crate::common::{
    process::{self, Start, can_serve},
    root, skipped,
};

fn read(name: &str) -> String {
    fs::read_to_string(root().join(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
}

/// Variables that the program knows: those of the configuration and `SEGSPLAT_CONFIG`.
fn known() -> BTreeSet<String> {
    let code = read("src/config.rs") + &read("src/cli/mod.rs");
    variables(&code)
}

/// Every `SEGSPLAT_…` word of a text.
fn variables(text: &str) -> BTreeSet<String> {
    let words = text.split(|c: char| !(c.is_ascii_uppercase() || c.is_ascii_digit() || c == '_'));
    words.filter(|word| word.starts_with("SEGSPLAT_")).map(str::to_owned).collect()
}

fn yaml(name: &str) -> Vec<Value> {
    let text = read(name);
    let documents = serde_yaml_ng::Deserializer::from_str(&text);
    let read = |document| serde::Deserialize::deserialize(document);
    documents.map(|d| read(d).unwrap_or_else(|e| panic!("{name}: {e}"))).collect()
}

/// The lines of the Dockerfile, each whole.
fn dockerfile() -> Vec<String> {
    let text = read("docker/Dockerfile").replace("\\\n", " ");
    let lines = text.lines().map(str::trim);
    lines.filter(|line| !line.is_empty() && !line.starts_with('#')).map(str::to_owned).collect()
}

#[test]
fn what_the_image_copies_exists_and_it_does_not_run_as_root() {
    let ignored: Vec<_> = read(".dockerignore").lines().map(str::to_owned).collect();
    let lines = dockerfile();
    let mut stages = BTreeSet::new();
    for line in &lines {
        if let Some((_, name)) = line.strip_prefix("FROM ").and_then(|from| from.split_once(" AS "))
        {
            stages.insert(name.to_owned());
        }
        let Some(copy) = line.strip_prefix("COPY ") else { continue };
        let words: Vec<&str> = copy.split_whitespace().collect();
        let (from, sources) = match words.split_first() {
            Some((first, rest)) if first.starts_with("--from=") => {
                (first.strip_prefix("--from="), &rest[..rest.len() - 1])
            }
            _ => (None, &words[..words.len() - 1]),
        };
        assert!(from.is_none_or(|stage| stages.contains(stage)), "{line}: no such stage");
        for source in sources {
            let path = source.trim_start_matches("/src/");
            // What the build stage makes: the program and what scripts/setup gets.
            if path.starts_with("target/") {
                let made = ["release/segsplat", "release/segsplat.spdx.json", "ort"];
                assert!(made.contains(&path.trim_start_matches("target/")), "{line}");
                continue;
            }
            assert!(root().join(path).exists(), "{line}: {path} is not in the repository");
            assert!(!ignored.iter().any(|i| path.starts_with(i)), "{line}: {path} is ignored");
        }
    }
    // By number, or Kubernetes cannot tell that it is not root; of group 0, as OpenShift has it.
    for target in ["base", "gpu"] {
        let start = lines.iter().position(|l| l.ends_with(&format!(" AS {target}"))).expect(target);
        let stage = lines[start + 1..].iter().take_while(|line| !line.starts_with("FROM "));
        let user = stage.filter(|line| line.starts_with("USER ")).last();
        assert_eq!(user.map(String::as_str), Some("USER 10001:0"), "{target}");
    }
    let whole = lines.join("\n");
    assert!(whole.contains("HEALTHCHECK") && whole.contains("[\"segsplat\", \"health\"]"));
    assert!(whole.contains("NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics"));
    assert!(whole.contains("libvulkan1 libegl1") && whole.contains("target/ort"));
    assert!(whole.contains("VK_DRIVER_FILES=/opt/segsplat/nvidia_vulkan.json"));
}

#[test]
fn every_image_of_others_is_named_by_its_digest_and_ours_by_their_version() {
    let bases = dockerfile().into_iter().filter_map(|line| {
        let (name, base) = line.strip_prefix("ARG ")?.split_once('=')?;
        name.ends_with("BASE").then(|| base.to_owned())
    });
    let compose = &yaml("docker/compose.yaml")[0]["services"];
    let services = compose.as_object().expect("services").values();
    // The replicas have theirs from `x-replica`.
    let used = services.filter_map(|service| Some(service["image"].as_str()?.to_owned()));
    let named: Vec<_> = bases.chain(used).filter(|image| !image.starts_with("segsplat:")).collect();
    assert_eq!(named.len(), 7, "{named:?}");
    for image in named {
        let digest = image.split_once("@sha256:").map_or("", |(_, digest)| digest);
        assert!(digest.len() == 64 && digest.bytes().all(|b| b.is_ascii_hexdigit()), "{image}");
    }
    let version = env!("CARGO_PKG_VERSION");
    assert!(dockerfile().contains(&format!("ARG VERSION={version}")));
    let chart = &yaml("docker/chart/Chart.yaml")[0];
    assert_eq!(
        (chart["version"].as_str(), chart["appVersion"].as_str()),
        (Some(version), Some(version))
    );
}

#[test]
fn every_variable_that_is_set_is_one_the_program_knows() {
    let known = known();
    assert!(known.len() > 15 && known.contains("SEGSPLAT_KEYS"), "{known:?}");
    let files = [
        "docker/Dockerfile",
        "docker/compose.yaml",
        "docker/kubernetes/segsplat.yaml",
        "docker/chart/templates/segsplat.yaml",
    ];
    for name in files {
        let set = variables(&read(name));
        assert!(!set.is_empty());
        let unknown: Vec<_> = set.difference(&known).collect();
        assert!(unknown.is_empty(), "{name} sets {unknown:?}");
    }
}

#[test]
fn compose_has_three_hardened_replicas_and_mounts_what_exists() {
    let compose = &yaml("docker/compose.yaml")[0];
    let replica = &compose["x-replica"];
    assert_eq!(replica["read_only"], true);
    assert_eq!(replica["build"]["target"], "cpu");
    let services = compose["services"].as_object().unwrap();
    let text = read("docker/compose.yaml");
    for name in ["replica1", "replica2", "replica3"] {
        assert!(services.contains_key(name), "{name}");
        let targets = yaml("docker/prometheus.yml")[0]["scrape_configs"].to_string();
        assert!(targets.contains(&format!("{name}:8080")), "{name} is not scraped");
    }
    assert_eq!(text.matches("<<: *replica").count(), 3);
    for (name, service) in services {
        for volume in service["volumes"].as_array().into_iter().flatten() {
            let (from, _) = volume.as_str().unwrap().split_once(':').unwrap();
            match from.strip_prefix("./") {
                Some(path) => assert!(root().join("docker").join(path).exists(), "{name}: {from}"),
                None => assert!(compose["volumes"].get(from).is_some(), "{name}: {from}"),
            }
        }
        for port in service["ports"].as_array().into_iter().flatten() {
            let port = port.as_str().unwrap();
            assert!(port.starts_with("127.0.0.1:"), "{name}: {port} is open to other machines");
        }
        let depends = service["depends_on"].as_array().into_iter().flatten();
        for other in depends {
            assert!(services.contains_key(other.as_str().unwrap()), "{name} needs {other}");
        }
    }
}

/// What HAProxy answers by itself has the body of our errors.
#[test]
fn the_balancer_s_own_errors_have_a_name() {
    let text = read("docker/haproxy.cfg");
    let mut statuses = Vec::new();
    for line in text.lines().filter(|line| line.trim_start().starts_with("http-error")) {
        let words: Vec<&str> = line.split_whitespace().collect();
        let body = line.split('\'').nth(1).expect("a body in quotes");
        let said: Value = serde_json::from_str(body).unwrap_or_else(|e| panic!("{e}: {body}"));
        let row = TABLE.iter().find(|row| said["code"] == row.name).expect("a code of ours");
        assert!(row.retry && said["details"]["retry"] == true, "{body}");
        assert!(said["message"].is_string() && said["request_id"].is_string(), "{body}");
        statuses.push(words[2]);
    }
    assert_eq!(statuses, ["502", "503", "504"]);
}

#[test]
fn the_manifests_probe_what_is_served_and_nothing_runs_as_root() {
    let documents = yaml("docker/kubernetes/segsplat.yaml");
    let kinds: Vec<_> = documents.iter().map(|d| d["kind"].as_str().unwrap()).collect();
    let want = [
        "Deployment",
        "Service",
        "PodDisruptionBudget",
        "HorizontalPodAutoscaler",
        "NetworkPolicy",
    ];
    assert_eq!(kinds, want);
    let pod = &documents[0]["spec"]["template"]["spec"];
    assert_eq!(pod["securityContext"]["runAsNonRoot"], true);
    let container = &pod["containers"][0];
    assert_eq!(container["securityContext"]["readOnlyRootFilesystem"], true);
    let paths: BTreeSet<_> = routes().iter().map(|route| route.path).collect();
    for probe in ["startupProbe", "readinessProbe", "livenessProbe"] {
        let path = container[probe]["httpGet"]["path"].as_str().expect(probe);
        assert!(paths.contains(path), "{probe}: {path}");
    }
    assert_ne!(
        container["readinessProbe"]["httpGet"]["path"],
        container["livenessProbe"]["httpGet"]["path"],
        "a replica that is not ready would be killed"
    );
    let metric = &documents[3]["spec"]["metrics"][0]["pods"]["metric"]["name"];
    assert_eq!(metric, "segsplat_jobs_queued");
    let endpoint = &yaml("docker/kubernetes/monitor.yaml")[0]["spec"]["endpoints"][0];
    assert!(paths.contains(endpoint["path"].as_str().expect("a path")), "{endpoint}");
    // One name for the port, which the service, the policy and the monitor use.
    let ingress = &documents[4]["spec"]["ingress"][0]["ports"][0]["port"];
    for port in [&documents[1]["spec"]["ports"][0]["targetPort"], ingress, &endpoint["port"]] {
        assert_eq!(port, &container["ports"][0]["name"]);
    }
    let drain = |name: &str| -> u64 {
        let env = container["env"].as_array().unwrap();
        let found = env.iter().find(|e| e["name"] == name).expect("set");
        found["value"].as_str().unwrap().parse().unwrap()
    };
    let grace = pod["terminationGracePeriodSeconds"].as_u64().unwrap() * 1_000;
    assert!(drain("SEGSPLAT_DRAIN_NOTICE_MS") + drain("SEGSPLAT_DRAIN_MS") < grace);
}

/// Makes every file system read-only but the folder `$1`, and runs the rest of the arguments as a
/// user of group 0 that has no name and no rights.
const CONFINED: &str = r#"
    data=$1; shift
    mounted=$(cut -d ' ' -f 2 /proc/self/mounts)
    mount --make-rprivate /
    mount --bind "$data" "$data"
    for at in $mounted; do mount -o remount,bind,ro "$at" 2> /dev/null || true; done
    exec setpriv --reuid 1234567 --regid 0 --clear-groups --bounding-set=-all --inh-caps=-all \
        --no-new-privs "$@"
"#;

/// As `OpenShift` runs the images. Needs the rights of root to give them up.
#[tokio::test]
async fn any_user_of_group_0_serves_from_a_read_only_root() {
    let mounts = Command::new("unshare").args(["--mount", "true"]).output();
    let hidden = |at: &&Path| fs::metadata(at).unwrap().permissions().mode() & 0o011 != 0o011;
    if !can_serve() || !mounts.is_ok_and(|done| done.status.success()) {
        println!("skipped: no root, which this test gives up");
        return;
    }
    if let Some(at) = root().ancestors().find(hidden) {
        println!("skipped: another user cannot see {}", at.display());
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o770)).unwrap();
    let at = folder.path().display().to_string();
    let server = Start::on(&folder.path().join("data"))
        .within(&["unshare", "--mount", "sh", "-euc", CONFINED, "confined", &at])
        .start();
    let status = fs::read_to_string(format!("/proc/{}/status", server.id())).unwrap();
    for line in ["Uid:\t1234567\t", "Gid:\t0\t", "CapEff:\t0000000000000000", "NoNewPrivs:\t1"] {
        assert!(status.contains(line), "{line}: {status}");
    }
    let mounts = fs::read_to_string(format!("/proc/{}/mounts", server.id())).unwrap();
    let root_fs = mounts.lines().rfind(|line| line.split(' ').nth(1) == Some("/"));
    assert!(root_fs.is_some_and(|line| line.contains(" ro,")), "{mounts}");

    let options = SampleOptions { photos: 2, width: 64, height: 48, seed: 1 };
    let (client, upload) = (crate::common::client(), sample::upload(&options).unwrap());
    let (status, said) =
        process::create(&client, &server.url, &upload, 60_000, None).await.unwrap();
    assert_eq!((status, said["state"].as_str()), (201, Some("done")), "{said}");
    let view = server.url(&format!("/v1/scenes/{}/view?from=0", said["id"].as_str().unwrap()));
    assert!(process::bytes(&client, &view).await.unwrap().unwrap().starts_with(b"\x89PNG"));
    assert!(server.stop(), "it ends well");
}

/// The GPU image names NVIDIA's driver to the Vulkan loader. Here a software adapter stands in its
/// place, so the loader finds it by the image's own file, and `gpu` refuses it by name.
#[test]
fn a_software_adapter_in_the_place_of_the_driver_is_refused() {
    let Some(drivers) = std::env::var_os("VK_DRIVER_FILES") else {
        skipped("no software Vulkan adapter (scripts/setup --ci gets it)");
        return;
    };
    let driver: Value = serde_json::from_slice(&fs::read(drivers).unwrap()).unwrap();
    let library = driver["ICD"]["library_path"].as_str().expect("a library");
    let folder = tempfile::tempdir().unwrap();
    symlink(library, folder.path().join("libEGL_nvidia.so.0")).unwrap();
    let found = std::env::var("LD_LIBRARY_PATH").unwrap_or_default();
    let beside = format!("{}:{found}", folder.path().display());
    let icd = root().join("docker/nvidia/vulkan.json");
    for (libraries, seen) in [(found, "none"), (beside, "\"llvmpipe")] {
        let ended = Command::new(env!("CARGO_BIN_EXE_segsplat"))
            .args(["serve", "--listen", "127.0.0.1:0", "--renderer", "gpu", "--bundle"])
            .arg(root().join("tests/fixtures/plane"))
            .arg("--data-dir")
            .arg(folder.path().join("data"))
            .env("LD_LIBRARY_PATH", libraries)
            .envs([("VK_DRIVER_FILES", &icd), ("VK_ICD_FILENAMES", &icd)])
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&ended.stderr);
        assert_eq!(ended.status.code(), Some(6), "{said}");
        assert!(said.contains(&format!("no hardware GPU adapter; there are: {seen}")), "{said}");
    }
}

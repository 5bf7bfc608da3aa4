//! Images, compose and manifests, as far as they can be held to the program without an engine:
//! what they copy exists, what they set is known, what they ask is served.

use std::{collections::BTreeSet, fs};

use segsplat::api::http::routes;
use serde_json::Value;

use crate::common::root;

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
                assert!(["target/release/segsplat", "target/ort"].contains(&path), "{line}");
                continue;
            }
            assert!(root().join(path).exists(), "{line}: {path} is not in the repository");
            assert!(!ignored.iter().any(|i| path.starts_with(i)), "{line}: {path} is ignored");
        }
    }
    for target in ["cpu", "gpu"] {
        let start =
            lines.iter().position(|l| l == &format!("FROM base AS {target}")).expect(target);
        let stage = lines[start + 1..].iter().take_while(|line| !line.starts_with("FROM "));
        let user = stage.filter(|line| line.starts_with("USER ")).last().expect("a user");
        assert!(!user.contains("root") && !user.contains(" 0"), "{target} runs as {user}");
    }
    let whole = lines.join("\n");
    assert!(whole.contains("HEALTHCHECK") && whole.contains("[\"segsplat\", \"health\"]"));
    assert!(whole.contains("NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics"));
    assert!(whole.contains("libvulkan1") && whole.contains("target/ort"));
}

#[test]
fn every_variable_that_is_set_is_one_the_program_knows() {
    let known = known();
    assert!(known.len() > 15 && known.contains("SEGSPLAT_KEYS"), "{known:?}");
    for name in ["docker/Dockerfile", "docker/compose.yaml", "docker/kubernetes/segsplat.yaml"] {
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

#[test]
fn the_manifests_probe_what_is_served_and_nothing_runs_as_root() {
    let documents = yaml("docker/kubernetes/segsplat.yaml");
    let kinds: Vec<_> = documents.iter().map(|d| d["kind"].as_str().unwrap()).collect();
    let want = ["Deployment", "Service", "PodDisruptionBudget", "HorizontalPodAutoscaler"];
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
    let drain = |name: &str| -> u64 {
        let env = container["env"].as_array().unwrap();
        let found = env.iter().find(|e| e["name"] == name).expect("set");
        found["value"].as_str().unwrap().parse().unwrap()
    };
    let grace = pod["terminationGracePeriodSeconds"].as_u64().unwrap() * 1_000;
    assert!(drain("SEGSPLAT_DRAIN_NOTICE_MS") + drain("SEGSPLAT_DRAIN_MS") < grace);
}

//! The recipes of the documentation do what they say, pasted one after the other into one shell.

use std::path::Path;
use std::process::Command;

/// The shell's blocks of a document that can be run here, with this address and this folder instead of theirs.
fn recipes(document: &str, port: u16, folder: &Path) -> Vec<String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let text = std::fs::read_to_string(root.join(document)).unwrap();
    let blocks = text.split("```sh\n").skip(1).map(|rest| rest.split("```").next().unwrap());
    // Those of the makefile build and test all there is.
    let blocks = blocks.filter(|block| !block.contains("make "));
    let here = folder.to_str().unwrap();
    let ours = blocks.map(|block| {
        let block = block.replace("127.0.0.1:8080", &format!("127.0.0.1:{port}"));
        let block = block.replace("/tmp/", &format!("{here}/"));
        // The default takes half a minute.
        block
            .replace("pnp-tv-fastdvdnet", "gap-tv")
            .replace("sci-recon submit ", "sci-recon submit --algorithm gap-tv ")
    });
    ours.collect()
}

/// Runs all recipes of some documents, in their order, where they find what they need, and gives what they print.
fn pasted(documents: &[&str], least: usize) -> String {
    for program in ["curl", "jq"] {
        if Command::new(program).arg("--version").output().is_err() {
            eprintln!("SKIPPED: there is no {program}");
            return String::new();
        }
    }
    let folder = tempfile::tempdir().unwrap();
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for name in ["demo", "runtime"] {
        std::os::unix::fs::symlink(root.join(name), folder.path().join(name)).unwrap();
    }
    let place = folder.path().join("target/release");
    std::fs::create_dir_all(&place).unwrap();
    let program = env!("CARGO_BIN_EXE_sci-recon");
    std::os::unix::fs::symlink(program, place.join("sci-recon")).unwrap();
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let recipes: Vec<_> =
        documents.iter().flat_map(|document| recipes(document, port, folder.path())).collect();
    assert!(recipes.len() >= least, "{recipes:#?}");
    // Job control, as in a shell that somebody types into; whatever is left of it ends with the script.
    let script = format!(
        "set -e -m -o pipefail\ntrap 'kill $(jobs -p) 2> /dev/null || true; wait' EXIT\n{}",
        recipes.join("\n")
    );
    let mut shell = Command::new("bash");
    shell.args(["-c", &script]).current_dir(folder.path()).env_remove("SCI_RECON_DATA");
    let output = shell.output().unwrap();
    let told = String::from_utf8_lossy(&output.stdout).into_owned();
    let log = std::fs::read_to_string(folder.path().join("serve.log")).unwrap_or_default();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{told}\n{errors}\n{log}\n{script}");
    told
}

#[test]
fn jobs_by_command_and_by_curl_and_a_calibration_from_captures_succeed() {
    let told = pasted(&["README.md", "docs/HTTP.md", "docs/DATA.md"], 6);
    assert!(told.is_empty() || told.contains("succeeded") && told.contains("ready"), "{told}");
    assert!(told.is_empty() || told.contains("\"grade\": \"good\""), "{told}");
}

#[test]
fn the_commands_for_lab_machines_and_offline_work() {
    let told = pasted(&["README.md", "docs/CLI.md"], 7);
    assert!(told.is_empty() || told.contains("succeeded") && told.contains("stack.tif"), "{told}");
}

#[test]
fn the_recipes_of_operations_work_in_their_order() {
    let told = pasted(&["docs/OPERATIONS.md"], 7);
    assert!(told.is_empty() || told.contains("succeeded"), "{told}");
}

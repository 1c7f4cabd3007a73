//! Runs the shell commands of the documents in one shell, in their order.

use std::path::Path;
use std::process::Command;

use crate::app::has_programs;

/// Shell blocks of a document that can be run here, with this port and folder.
fn recipes(document: &str, port: u16, folder: &Path) -> Vec<String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let text = std::fs::read_to_string(root.join(document)).unwrap();
    let blocks = text.split("```sh\n").skip(1).map(|rest| rest.split("```").next().unwrap());
    // Blocks that call make build and test everything.
    let blocks = blocks.filter(|block| !block.contains("make "));
    let here = folder.to_str().unwrap();
    let ours = blocks.map(|block| {
        let block = block.replace("127.0.0.1:8080", &format!("127.0.0.1:{port}"));
        let block = block.replace("/tmp/", &format!("{here}/"));
        // The default algorithm takes half a minute.
        block
            .replace("pnp-tv-fastdvdnet", "gap-tv")
            .replace("sci-recon submit ", "sci-recon submit --algorithm gap-tv ")
            // A manifest states its algorithm.
            .replace("--algorithm gap-tv --manifest", "--manifest")
    });
    ours.collect()
}

/// Runs the shell blocks of some documents in their order, and returns their output. There must be at least `minimum`
/// blocks. Returns an empty text after [`skip`].
fn pasted(documents: &[&str], minimum: usize) -> String {
    if !has_programs(&["curl", "jq"], "curl jq") {
        return String::new();
    }
    let folder = tempfile::tempdir().unwrap();
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for name in ["demo", "runtime"] {
        std::os::unix::fs::symlink(root.join(name), folder.path().join(name)).unwrap();
    }
    let programs = folder.path().join("target/release");
    std::fs::create_dir_all(&programs).unwrap();
    let program = env!("CARGO_BIN_EXE_sci-recon");
    std::os::unix::fs::symlink(program, programs.join("sci-recon")).unwrap();
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let recipes: Vec<_> =
        documents.iter().flat_map(|document| recipes(document, port, folder.path())).collect();
    assert!(recipes.len() >= minimum, "{recipes:#?}");
    // The shell has job control, like an interactive one. The trap ends the remaining processes.
    let script = format!(
        "set -e -m -o pipefail\ntrap 'kill $(jobs -p) 2> /dev/null || true; wait' EXIT\n{}",
        recipes.join("\n")
    );
    let mut shell = Command::new("bash");
    shell.args(["-c", &script]).current_dir(folder.path()).env_remove("SCI_RECON_DATA");
    let output = shell.output().unwrap();
    let printed = String::from_utf8_lossy(&output.stdout).into_owned();
    let log = std::fs::read_to_string(folder.path().join("serve.log")).unwrap_or_default();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{printed}\n{errors}\n{log}\n{script}");
    printed
}

#[test]
fn data_and_http_commands_work() {
    let printed = pasted(&["README.md", "docs/HTTP.md", "docs/DATA.md"], 6);
    assert!(
        printed.is_empty() || printed.contains("succeeded") && printed.contains("ready"),
        "{printed}"
    );
    assert!(printed.is_empty() || printed.contains("\"grade\": \"good\""), "{printed}");
}

#[test]
fn client_and_offline_commands_work() {
    let printed = pasted(&["README.md", "docs/CLI.md"], 7);
    assert!(
        printed.is_empty() || printed.contains("; finished") && printed.contains("stack.tif"),
        "{printed}"
    );
}

#[test]
fn operations_commands_work_in_their_order() {
    let printed = pasted(&["docs/OPERATIONS.md"], 7);
    assert!(printed.is_empty() || printed.contains("; finished"), "{printed}");
}

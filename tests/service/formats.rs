//! What is refused, and the lines of the documentation that convert it.

use crate::app::TestApp;

/// The commands of the table in `docs/formats.md`.
fn lines() -> Vec<String> {
    let text = std::fs::read_to_string("docs/formats.md").unwrap();
    let (_, table) = text.split_once("## What is refused").unwrap();
    let (table, _) = table.split_once("\n## ").unwrap();
    let commands =
        table.lines().filter_map(|row| row.split('`').find(|part| part.starts_with("python -c")));
    commands.map(str::to_owned).collect()
}

#[tokio::test]
async fn every_line_that_converts_does_so() {
    let Ok(python) = std::env::var("SCI_RECON_JUDGES") else {
        eprintln!("SKIPPED: SCI_RECON_JUDGES names no Python with tests/judges/requirements.txt");
        return;
    };
    let app = TestApp::start().await;
    let folder = tempfile::tempdir().unwrap();
    let run = |command: &mut std::process::Command| {
        let output = command.output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    };
    run(std::process::Command::new(&python)
        .arg("tests/judges/refused_files.py")
        .arg(folder.path()));
    let lines = lines();
    assert!(lines.len() >= 4, "{lines:?}");
    for line in lines {
        let code = line.strip_prefix("python -c \"").unwrap().strip_suffix('"').unwrap();
        let name = |mark: &str| {
            let (_, rest) = code.split_once(&format!("'{mark}.")).unwrap();
            format!("{mark}.{}", rest.split('\'').next().unwrap())
        };
        let read = |name: String| std::fs::read(folder.path().join(name)).unwrap();
        // Masks with their axes in another order look like others; all else is refused, with its line.
        if name("in") != "in.npy" {
            let refused = app.calibrate(read(name("in"))).await.problem(422, "invalid_content");
            assert!(refused.contains(&line), "no {line} in {refused}");
        }
        run(std::process::Command::new(&python).args(["-c", code]).current_dir(folder.path()));
        let made = app.calibrate(read(name("out"))).await.expect(201).json();
        let frames = if name("out").ends_with("npy") { 4 } else { 1 };
        let shape = (&made["frames"], &made["height"], &made["width"]);
        assert_eq!(serde_json::json!(shape), serde_json::json!([frames, 48, 64]), "{line}");
        std::fs::remove_file(folder.path().join(name("out"))).unwrap();
    }
}

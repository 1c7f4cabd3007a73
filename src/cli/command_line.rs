//! The command line of the program: defines the commands in groups, and runs them.

use std::ffi::OsString;
use std::fmt::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

use super::CliError;
use super::error::Result;
use super::output::print_line;
use crate::config;

/// Reconstruct video from snapshot compressive measurements.
#[derive(Debug, Parser)]
#[command(name = "sci-recon", version = config::VERSION, propagate_version = true)]
struct Arguments {
    /// Address of the service, for lab machine commands.
    #[arg(long, value_name = "URL", display_order = 990)]
    url: Option<String>,
    /// Token of the lab, for lab machine commands.
    #[arg(long, value_name = "TOKEN", display_order = 991)]
    token: Option<String>,
    /// Read options from a TOML file (docs/CLI.md).
    #[arg(
        long,
        env = "SCI_RECON_CONFIG",
        value_name = "FILE",
        global = true,
        display_order = 1000
    )]
    config: Option<PathBuf>,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Submit(super::submit::Arguments),
    Watch(super::watch::Arguments),
    Fetch(super::fetch::Arguments),
    Ls(super::ls::Arguments),
    Cancel(super::cancel::Arguments),
    WatchFolder(super::watch_folder::Arguments),
    Serve(config::ServeArguments),
    Worker(config::WorkerArguments),
    Devices(super::devices::Arguments),
    Health(super::health::Arguments),
    Token(super::token::Arguments),
    Lab(super::lab::Arguments),
    Job(super::job::Arguments),
    Backup(super::backup::Arguments),
    Verify(super::verify::Arguments),
    Cluster(super::cluster::Arguments),
    /// Show settings and their origins.
    Config {
        #[command(subcommand)]
        action: ConfigAction,
    },
    Completions(super::shell::Completions),
    Man(super::shell::Man),
    Reconstruct(super::reconstruct::Arguments),
    Simulate(super::simulate::Arguments),
    Calibrate(super::calibrate::Arguments),
    Optics(super::optics::Arguments),
    Schedule(super::schedule::Arguments),
    CheckModel(super::check_model::Arguments),
    Demo(super::demo::Arguments),
    RunModel(super::run_model::Arguments),
}

#[derive(Debug, Subcommand)]
enum ConfigAction {
    /// Print the options of a command, their values and their origins.
    ///
    /// An origin is the command line, an environment variable, the configuration file or the default.
    Show {
        /// The command, such as `serve` or `token create`.
        #[arg(default_value = "serve", num_args = 1..)]
        names: Vec<String>,
        /// Options as on the command line of that command.
        #[arg(last = true, value_name = "OPTIONS")]
        rest: Vec<OsString>,
    },
}

/// Headings of the help, and the commands below each.
const GROUPS: [(&str, &[&str]); 4] = [
    ("Lab machine", &["submit", "watch", "fetch", "ls", "cancel", "watch-folder"]),
    ("Server", &["serve", "worker", "devices", "health"]),
    (
        "Administration",
        &["token", "lab", "job", "backup", "verify", "cluster", "config", "completions", "man"],
    ),
    (
        "Offline",
        &["reconstruct", "simulate", "calibrate", "optics", "schedule", "check-model", "demo"],
    ),
];

/// The root command, with a help that lists the commands in groups.
fn command() -> clap::Command {
    let root = Arguments::command();
    let width = root.get_subcommands().map(|command| command.get_name().len()).max();
    let width = width.unwrap_or_default();
    let mut template = "{about-with-newline}\n{usage-heading} {usage}\n".to_owned();
    for (heading, names) in GROUPS {
        // Writing to a string can't fail.
        let _ = write!(template, "\n{heading}:\n");
        for name in names {
            let about = root.find_subcommand(name).and_then(clap::Command::get_about);
            let about = about.map(ToString::to_string).unwrap_or_default();
            let _ = writeln!(template, "  {name:width$}  {about}");
        }
    }
    template += "\nOptions:\n{options}\n\n`sci-recon COMMAND --help` describes the options of a command.\n\n\
                 Exit codes: 0 success, 1 failure, 2 wrong input, 3 done, but the verdict is bad.";
    root.help_template(template)
}

/// Runs a command line. Its first word is the name of the program.
pub fn run(line: Vec<OsString>) -> ExitCode {
    let outcome = super::settings::expand(&command(), line).and_then(|expanded| {
        let parsed = command().try_get_matches_from(&expanded.line);
        let parsed = parsed.and_then(|matches| Arguments::from_arg_matches(&matches));
        let arguments = parsed.unwrap_or_else(|error| {
            if let Some(origin) = expanded.origin_of(&error) {
                eprintln!("sci-recon: {origin}");
            }
            error.exit()
        });
        perform(arguments)
    });
    let Err(error) = outcome else { return ExitCode::SUCCESS };
    if !matches!(error, CliError::Unread) {
        eprintln!("sci-recon: {error}");
    }
    error.exit_code()
}

fn perform(arguments: Arguments) -> Result<()> {
    match arguments.command {
        Command::Submit(arguments) => super::submit::run(&arguments),
        Command::Watch(arguments) => super::watch::run(&arguments),
        Command::Fetch(arguments) => super::fetch::run(&arguments),
        Command::Ls(arguments) => super::ls::run(&arguments),
        Command::Cancel(arguments) => super::cancel::run(&arguments),
        Command::WatchFolder(arguments) => super::watch_folder::run(&arguments),
        Command::Serve(arguments) => super::serve::run(&arguments).map_err(CliError::from),
        Command::Worker(arguments) => super::worker::run(&arguments),
        Command::Devices(arguments) => super::devices::run(&arguments),
        Command::Health(arguments) => super::health::run(&arguments),
        Command::Token(arguments) => super::token::run(&arguments),
        Command::Lab(arguments) => super::lab::run(&arguments),
        Command::Job(arguments) => super::job::run(&arguments),
        Command::Backup(arguments) => super::backup::run(&arguments),
        Command::Verify(arguments) => super::verify::run(&arguments),
        Command::Cluster(arguments) => super::cluster::run(&arguments),
        Command::Config { action: ConfigAction::Show { names, rest } } => {
            print_line(super::settings::show(&command(), &names, &rest, arguments.config)?)
        }
        Command::Completions(arguments) => super::shell::completions(&arguments, command()),
        Command::Man(arguments) => super::shell::man(&arguments, command()),
        Command::Reconstruct(arguments) => super::reconstruct::run(&arguments),
        Command::Simulate(arguments) => super::simulate::run(&arguments),
        Command::Calibrate(arguments) => super::calibrate::run(&arguments),
        Command::Optics(arguments) => super::optics::run(&arguments),
        Command::Schedule(arguments) => super::schedule::run(&arguments),
        Command::CheckModel(arguments) => super::check_model::run(&arguments),
        Command::Demo(arguments) => super::demo::run(&arguments),
        Command::RunModel(arguments) => super::run_model::run(&arguments),
    }
}

#[cfg(test)]
mod tests {
    use super::{GROUPS, command};

    /// Width of a terminal that the unwrapped help must fit.
    const COLUMNS: usize = 80;

    #[test]
    fn the_help_describes_every_command_once() {
        let root = command();
        root.clone().debug_assert();
        let visible = root.get_subcommands().filter(|command| !command.is_hide_set());
        let mut visible: Vec<&str> = visible.map(clap::Command::get_name).collect();
        let mut grouped: Vec<&str> = GROUPS.iter().flat_map(|(_, names)| *names).copied().collect();
        visible.sort_unstable();
        grouped.sort_unstable();
        assert_eq!(grouped, visible);
        let help = root.clone().render_help().to_string();
        for name in grouped {
            let about = root.find_subcommand(name).unwrap().get_about().unwrap().to_string();
            let lines = help.lines().filter(|line| line.starts_with(&format!("  {name} ")));
            let lines: Vec<&str> = lines.collect();
            assert!(lines.len() == 1 && lines[0].ends_with(&about), "{name}: {lines:?}");
            assert!(lines[0].len() <= COLUMNS, "{} columns: {}", lines[0].len(), lines[0]);
        }
        let config = help.find("--config").unwrap();
        assert!(help.find("--version").unwrap() < config, "--config is last\n{help}");
        assert!(help[config..].contains("Exit codes"), "{help}");
    }

    #[test]
    fn descriptions_are_in_the_imperative() {
        fn check(command: &clap::Command) {
            for below in command.get_subcommands().filter(|below| !below.is_hide_set()) {
                let about = below.get_about().unwrap_or_else(|| panic!("{}", below.get_name()));
                let about = about.to_string();
                let verb = about.split(' ').next().unwrap();
                // "Compress" and "process" are imperatives that end in s.
                let imperative = !verb.ends_with('s') || verb.ends_with("ss");
                assert!(imperative, "{}: {about}", below.get_name());
                check(below);
            }
        }
        check(&command());
    }
}

//! The `sci-recon` program.

use std::ffi::OsString;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use sci_recon::cli::{self, CliError};
use sci_recon::config;

/// Reconstructs video from snapshot compressive measurements, over HTTP or right here.
#[derive(Debug, Parser)]
#[command(version = config::VERSION, propagate_version = true)]
struct Arguments {
    /// Configuration file in TOML: keys are the long names of options, at the top for all commands or in a
    /// table such as [serve] for one. Environment and command line go before it.
    #[arg(long, env = "SCI_RECON_CONFIG", value_name = "FILE", global = true)]
    config: Option<PathBuf>,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Serve(config::ServeArguments),
    Worker(config::WorkerArguments),
    Submit(cli::submit::Arguments),
    Watch(cli::watch::Arguments),
    Fetch(cli::fetch::Arguments),
    Ls(cli::ls::Arguments),
    Cancel(cli::cancel::Arguments),
    WatchFolder(cli::watch_folder::Arguments),
    Reconstruct(cli::reconstruct::Arguments),
    Simulate(cli::simulate::Arguments),
    Schedule(cli::schedule::Arguments),
    Optics(cli::optics::Arguments),
    Calibrate(cli::calibrate::Arguments),
    Demo(cli::demo::Arguments),
    Token(cli::token::Arguments),
    Lab(cli::lab::Arguments),
    Job(cli::job::Arguments),
    Backup(cli::backup::Arguments),
    Verify(cli::verify::Arguments),
    CheckModel(cli::check_model::Arguments),
    RunModel(cli::run_model::Arguments),
    #[cfg(feature = "nats")]
    Cluster(cli::cluster::Arguments),
    Health(cli::health::Arguments),
    /// Shows settings and where each comes from.
    Config {
        #[command(subcommand)]
        action: ConfigAction,
    },
    Completions(cli::shell::Completions),
    Man(cli::shell::Man),
}

#[derive(Debug, Subcommand)]
enum ConfigAction {
    /// Prints the options of a command, their values, and whether the command line, the environment, the
    /// configuration file or the program says so.
    Show {
        /// The command.
        #[arg(default_value = "serve")]
        name: String,
        /// What would stand on its command line.
        #[arg(last = true, value_name = "OPTIONS")]
        rest: Vec<OsString>,
    },
}

fn main() -> ExitCode {
    match cli::settings::expand(&Arguments::command(), std::env::args_os().collect()) {
        Ok(line) => run(line),
        Err(error) => ended(&error),
    }
}

fn ended(error: &CliError) -> ExitCode {
    eprintln!("sci-recon: {error}");
    error.exit_code()
}

fn run(line: Vec<OsString>) -> ExitCode {
    let parsed = Arguments::command().try_get_matches_from(line);
    let parsed = parsed.and_then(|matches| Arguments::from_arg_matches(&matches));
    let Arguments { config, command } = parsed.unwrap_or_else(|error| error.exit());
    let outcome = match command {
        Command::Serve(arguments) => cli::serve::run(&arguments).map_err(CliError::from),
        Command::Worker(arguments) => cli::worker::run(&arguments),
        Command::Submit(arguments) => cli::submit::run(&arguments),
        Command::Watch(arguments) => cli::watch::run(&arguments),
        Command::Fetch(arguments) => cli::fetch::run(&arguments),
        Command::Ls(arguments) => cli::ls::run(&arguments),
        Command::Cancel(arguments) => cli::cancel::run(&arguments),
        Command::WatchFolder(arguments) => cli::watch_folder::run(&arguments),
        Command::Reconstruct(arguments) => cli::reconstruct::run(&arguments),
        Command::Schedule(arguments) => cli::schedule::run(&arguments),
        Command::Optics(arguments) => cli::optics::run(&arguments),
        Command::Calibrate(arguments) => cli::calibrate::run(&arguments),
        Command::Simulate(arguments) => cli::simulate::run(&arguments),
        Command::Demo(arguments) => cli::demo::run(&arguments),
        Command::Token(arguments) => cli::token::run(&arguments),
        Command::Lab(arguments) => cli::lab::run(&arguments),
        Command::Job(arguments) => cli::job::run(&arguments),
        Command::Backup(arguments) => cli::backup::run(&arguments),
        Command::Verify(arguments) => cli::verify::run(&arguments),
        Command::CheckModel(arguments) => cli::check_model::run(&arguments),
        Command::RunModel(arguments) => cli::run_model::run(&arguments),
        #[cfg(feature = "nats")]
        Command::Cluster(arguments) => cli::cluster::run(&arguments),
        Command::Health(arguments) => cli::health::run(&arguments),
        Command::Config { action: ConfigAction::Show { name, rest } } => {
            cli::settings::show(&Arguments::command(), &name, &rest, config)
                .map(|text| println!("{text}"))
        }
        Command::Completions(arguments) => {
            cli::shell::completions(&arguments, Arguments::command());
            Ok(())
        }
        Command::Man(arguments) => cli::shell::man(&arguments, Arguments::command()),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => ended(&error),
    }
}

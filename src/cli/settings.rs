//! The configuration file: TOML whose keys are the long names of options. What stands in it is taken where
//! neither the command line nor the environment says otherwise.
//!
//! A key at the top is for every command that has the option; one in the table `[serve]`, say, for that
//! command alone. No crate for layers of settings is used: those that are well kept read into structures of
//! their own, and clap, which has all names, defaults and checks, can't tell them what it found.

use std::ffi::{OsStr, OsString};
use std::fs;
use std::path::PathBuf;

use clap::{Arg, ArgAction, Command};
use toml::{Table, Value};

use super::CliError;
use crate::cli::error::Result;

/// The option and the variable that name the file.
const OPTION: &str = "--config";
const VARIABLE: &str = "SCI_RECON_CONFIG";

/// Where a setting comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Origin {
    Line,
    Variable(String),
    File(PathBuf),
    Default,
}

/// The command line with what the configuration file, if there is one, adds to it.
/// Errors: a file that can't be read; keys that no option has.
pub fn expand(root: &Command, line: Vec<OsString>) -> Result<Vec<OsString>> {
    let Some(path) = named(&line) else { return Ok(line) };
    let entries = read(root, &path)?;
    let Some((at, command)) = subcommand(root, &line) else { return Ok(line) };
    let mut expanded = line[..=at].to_vec();
    for (_, key, texts) in entries.iter().filter(|(of, ..)| of == command.get_name()) {
        let Some(arg) = option(command, key) else { continue };
        if origin(arg, &line[at + 1..]) == Origin::Default {
            expanded.extend(texts.iter().filter_map(|text| tokens(arg, text)));
        }
    }
    expanded.extend_from_slice(&line[at + 1..]);
    Ok(expanded)
}

/// A table of all options of a command with their values and where those come from; `rest` is what would
/// stand on its command line.
/// Errors: those of [`expand`].
pub fn show(
    root: &Command,
    name: &str,
    rest: &[OsString],
    path: Option<PathBuf>,
) -> Result<String> {
    let path = path.or_else(|| named(rest));
    let entries = path.as_ref().map_or(Ok(Vec::new()), |path| read(root, path))?;
    let command = root.find_subcommand(name);
    let command =
        command.ok_or_else(|| CliError::Input(format!("there is no command {name:?}")))?;
    let mut lines = vec![format!("{:24}{:40}from", "option", "value")];
    let shown =
        |arg: &&Arg| !arg.is_hide_set() && arg.get_long().is_some_and(|name| name != "help");
    for arg in command.get_arguments().filter(shown) {
        let key = arg.get_long().unwrap_or_default();
        let in_file = entries.iter().find(|(of, found, _)| of == name && found == key);
        let (value, from) = match (origin(arg, rest), in_file, &path) {
            (Origin::Default, Some((.., texts)), Some(path)) => {
                (texts.join(","), Origin::File(path.clone()))
            }
            (origin, ..) => (value(arg, rest, &origin), origin),
        };
        let secret = arg.is_hide_env_values_set() && from != Origin::Default;
        let value = if secret { "(hidden)".to_owned() } else { value };
        let from = match from {
            Origin::Line => "the command line".to_owned(),
            Origin::Variable(name) => format!("the variable {name}"),
            Origin::File(path) => path.display().to_string(),
            Origin::Default => "the default".to_owned(),
        };
        lines.push(format!("{key:24}{value:40}{from}"));
    }
    Ok(lines.join("\n"))
}

/// The file that the command line or the environment names.
fn named(line: &[OsString]) -> Option<PathBuf> {
    let options = line.iter().take_while(|token| *token != "--");
    let at = options.clone().position(|token| token == OPTION);
    let joined = options.filter_map(|token| token.to_str()?.strip_prefix("--config="));
    let variable = || std::env::var_os(VARIABLE).filter(|path| !path.is_empty());
    at.and_then(|at| line.get(at + 1).map(PathBuf::from))
        .or_else(|| joined.last().map(PathBuf::from))
        .or_else(|| variable().map(PathBuf::from))
}

/// The first word of the line that is a command, and where it stands.
fn subcommand<'a>(root: &'a Command, line: &[OsString]) -> Option<(usize, &'a Command)> {
    let mut words = line.iter().enumerate().skip(1);
    words.find_map(|(at, word)| Some((at, root.find_subcommand(word)?)))
}

/// Command, option and values of each entry.
fn read(root: &Command, path: &PathBuf) -> Result<Vec<(String, String, Vec<String>)>> {
    let refused = |text: &dyn std::fmt::Display| {
        CliError::Input(format!("the configuration file {}: {text}", path.display()))
    };
    let text = fs::read_to_string(path).map_err(|error| refused(&error))?;
    let table: Table = text.parse().map_err(|error: toml::de::Error| refused(&error))?;
    let mut entries = Vec::new();
    for (key, value) in &table {
        match value {
            Value::Table(own) => {
                let command = root.find_subcommand(key);
                let command = command.ok_or_else(|| refused(&format!("no command is {key:?}")))?;
                for (key, value) in own {
                    let name = command.get_name();
                    option(command, key)
                        .ok_or_else(|| refused(&format!("{name} has no option {key:?}")))?;
                    let texts = texts(value).map_err(|what| refused(&format!("{key}: {what}")))?;
                    entries.push((name.to_owned(), key.clone(), texts));
                }
            }
            _ => {
                let texts = texts(value).map_err(|what| refused(&format!("{key}: {what}")))?;
                let commands = root.get_subcommands().filter(|of| option(of, key).is_some());
                let names: Vec<_> = commands.map(|of| of.get_name().to_owned()).collect();
                if names.is_empty() {
                    return Err(refused(&format!("no command has an option {key:?}")));
                }
                let own = |name: &String| {
                    let of_its_own = table.get(name).and_then(Value::as_table);
                    of_its_own.is_some_and(|table| table.contains_key(key))
                };
                let names = names.into_iter().filter(|name| !own(name));
                entries.extend(names.map(|name| (name, key.clone(), texts.clone())));
            }
        }
    }
    Ok(entries)
}

fn option<'a>(command: &'a Command, key: &str) -> Option<&'a Arg> {
    command.get_arguments().find(|arg| arg.get_long() == Some(key))
}

/// The values as they would stand on a command line.
fn texts(value: &Value) -> Result<Vec<String>, &'static str> {
    match value {
        Value::String(text) => Ok(vec![text.clone()]),
        Value::Integer(number) => Ok(vec![number.to_string()]),
        Value::Float(number) => Ok(vec![number.to_string()]),
        Value::Boolean(flag) => Ok(vec![flag.to_string()]),
        Value::Array(values) => {
            Ok(values.iter().map(texts).collect::<Result<Vec<_>, _>>()?.concat())
        }
        Value::Table(_) | Value::Datetime(_) => Err("a text, a number, true, false or a list fits"),
    }
}

/// An option with a value, as it stands on a command line.
fn tokens(arg: &Arg, text: &str) -> Option<OsString> {
    let name = arg.get_long()?;
    match (arg.get_action(), text) {
        (ArgAction::SetTrue, "true") => Some(format!("--{name}").into()),
        (ArgAction::SetTrue, "false") => None,
        _ => Some(format!("--{name}={text}").into()),
    }
}

/// Where an option comes from, apart from the file.
fn origin(arg: &Arg, line: &[OsString]) -> Origin {
    if on_line(arg, line).is_some() {
        return Origin::Line;
    }
    match arg.get_env() {
        Some(name) if std::env::var_os(name).is_some() => {
            Origin::Variable(name.to_string_lossy().into_owned())
        }
        _ => Origin::Default,
    }
}

/// The value of an option on a command line.
fn on_line(arg: &Arg, line: &[OsString]) -> Option<String> {
    let name = format!("--{}", arg.get_long()?);
    let text = |token: &OsStr| token.to_string_lossy().into_owned();
    line.iter().enumerate().find_map(|(at, token)| {
        let token = text(token);
        let rest = token.strip_prefix(&name)?;
        match rest.strip_prefix('=') {
            Some(value) => Some(value.to_owned()),
            None if !rest.is_empty() => None,
            None if matches!(arg.get_action(), ArgAction::SetTrue) => Some("true".into()),
            None => Some(line.get(at + 1).map(|value| text(value)).unwrap_or_default()),
        }
    })
}

fn value(arg: &Arg, line: &[OsString], origin: &Origin) -> String {
    let text = |value: &OsStr| value.to_string_lossy().into_owned();
    match origin {
        Origin::Line => on_line(arg, line).unwrap_or_default(),
        Origin::Variable(name) => {
            std::env::var_os(name).map(|value| text(&value)).unwrap_or_default()
        }
        Origin::File(_) => String::new(),
        Origin::Default => {
            let values: Vec<String> = arg.get_default_values().iter().map(|v| text(v)).collect();
            if values.is_empty() { "-".into() } else { values.join(",") }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::ffi::OsString;
    use std::fs;

    use clap::{Arg, ArgAction, Command};

    use super::{expand, show};

    fn root() -> Command {
        let data = || Arg::new("data").long("data");
        Command::new("sci-recon")
            .subcommand(
                Command::new("serve")
                    .arg(data())
                    .arg(Arg::new("open").long("open").action(ArgAction::SetTrue))
                    .arg(Arg::new("hosts").long("host").action(ArgAction::Append))
                    .arg(Arg::new("most").long("most").default_value("7").env("SCI_TEST_MOST")),
            )
            .subcommand(Command::new("token").arg(data()))
    }

    fn with(text: &str, line: &[&str]) -> Result<Vec<String>, String> {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("sci.toml");
        fs::write(&file, text).unwrap();
        let option = format!("--config={}", file.display());
        let mut all: Vec<OsString> = vec!["sci-recon".into(), option.into()];
        all.extend(line.iter().map(|token| OsString::from(*token)));
        let expanded = expand(&root(), all).map_err(|error| error.to_string())?;
        Ok(expanded[2..].iter().map(|token| token.to_str().unwrap().to_owned()).collect())
    }

    #[test]
    fn the_file_says_what_nobody_else_does() {
        let file = "data = \"/a\"\n[serve]\nopen = true\nhost = [\"x\", \"y\"]\nmost = 9\n";
        let serve = with(file, &["serve"]).unwrap();
        assert_eq!(serve, ["serve", "--data=/a", "--host=x", "--host=y", "--most=9", "--open"]);
        assert_eq!(with(file, &["token", "list"]).unwrap(), ["token", "--data=/a", "list"]);
        let line = ["serve", "--data", "/b", "--most=3", "--host=z", "--open"];
        assert_eq!(with(file, &line).unwrap(), line, "the command line has the last word");
        assert_eq!(
            with("data = \"/a\"\n[token]\ndata = \"/c\"", &["token"]).unwrap(),
            ["token", "--data=/c"]
        );
        assert_eq!(with("[serve]\nopen = false", &["serve"]).unwrap(), ["serve"]);
    }

    #[test]
    fn what_is_wrong_in_the_file_is_named() {
        for (text, named) in [
            ("dat = 1", "no command has an option \"dat\""),
            ("[serve]\nlist = 1", "serve has no option \"list\""),
            ("[server]\nmost = 1", "no command is \"server\""),
            ("[serve]\nmost = 2001-01-01", "most: a text, a number"),
            ("most", "TOML"),
        ] {
            let error = with(text, &["serve"]).unwrap_err();
            assert!(error.contains(named) && error.contains("sci.toml"), "{error}");
        }
        let line = ["sci-recon", "--config", "/nowhere/x.toml", "serve"].map(OsString::from);
        assert!(expand(&root(), line.into()).unwrap_err().to_string().contains("/nowhere/x.toml"));
    }

    #[test]
    fn a_table_says_where_each_value_comes_from() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("sci.toml");
        fs::write(&file, "data = \"/a\"").unwrap();
        let text = show(&root(), "serve", &["--open".into()], Some(file.clone())).unwrap();
        let line = |key: &str| {
            let found = text.lines().find(|line| line.starts_with(key)).unwrap();
            found.split_whitespace().map(str::to_owned).collect::<Vec<_>>()
        };
        assert_eq!(line("data"), ["data", "/a", file.to_str().unwrap()]);
        assert_eq!(line("open"), ["open", "true", "the", "command", "line"]);
        assert_eq!(line("most"), ["most", "7", "the", "default"]);
        assert_eq!(line("host"), ["host", "-", "the", "default"]);
    }
}

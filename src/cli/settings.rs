//! The configuration file: TOML with long option names as keys. It supplies the options that neither the
//! command line nor the environment sets.
//!
//! A key at the top applies to every command that has the option. A key in a table, such as `[serve]` or
//! `[token.create]`, applies to that command and the commands below it, and wins over keys further up.
//!
//! Clap decides where the name of a command stands and which options are set. The file's options are inserted
//! after that name. They can't be default values: clap ignores those in `required_unless_present`.

use std::ffi::{OsStr, OsString};
use std::fs;
use std::path::PathBuf;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::parser::ValueSource;
use clap::{Arg, ArgAction, ArgMatches, Command};
use toml::{Table, Value};

use super::CliError;
use crate::cli::error::Result;

/// Identifier of the root option that names the file.
const CONFIG: &str = "config";
/// Smallest Jaro similarity at which a valid name is suggested for an unknown one.
const SIMILAR: f64 = 0.7;

/// A command line with the options that the configuration file adds to it.
#[derive(Debug)]
pub struct Expanded {
    pub line: Vec<OsString>,
    path: Option<PathBuf>,
    added: Vec<String>,
}

impl Expanded {
    /// Names the configuration file if `error` is about an option that comes from it.
    pub fn origin_of(&self, error: &clap::Error) -> Option<String> {
        let Some(ContextValue::String(argument)) = error.get(ContextKind::InvalidArg) else {
            return None;
        };
        let name = argument.split([' ', '=']).next()?.strip_prefix("--")?;
        let is_added = self.added.iter().any(|added| added == name);
        let path = self.path.as_ref().filter(|_| is_added)?;
        Some(format!("{name} is set by the configuration file {}", path.display()))
    }
}

/// Adds the options of the configuration file, and moves options of the program that belong to a command, such
/// as `--url`, behind the name of that command.
/// Errors: a file that can't be read; unknown keys; values of the wrong type.
pub fn expand(root: &Command, line: Vec<OsString>) -> Result<Expanded> {
    // `--help` and `--version` end here; the caller's own parser prints them.
    let Ok(matches) = lenient(root, &line) else {
        return Ok(Expanded { line, path: None, added: Vec::new() });
    };
    let file = match path_in(&matches) {
        Some(path) => Some(File::read(root, path)?),
        None => None,
    };
    let mut expanded: Vec<OsString> = line.iter().take(1).cloned().collect();
    let mut rest = line.get(1..).unwrap_or_default();
    let (mut command, mut set, mut names) = (root, &matches, Vec::new());
    let mut inherited = Vec::new();
    let mut added = Vec::new();
    while let Some(end) = end_of_name(command, &inherited, rest)
        && let Some((name, set_below)) = set.subcommand()
        && let Some(below) = command.find_subcommand(name)
    {
        expanded.extend_from_slice(&rest[..end]);
        rest = &rest[end..];
        let passed = passed_on(command, set);
        if let Some((option, _)) = passed.iter().find(|(key, _)| option(below, key).is_none()) {
            let text = format!("{name} takes no --{option}; see sci-recon {name} --help");
            return Err(CliError::Input(text));
        }
        names.push(name);
        for arg in options(below).filter(|arg| !is_on_line(arg, set_below)) {
            let key = arg.get_long().unwrap_or_default();
            if let Some((_, value)) = passed.iter().find(|(name, _)| name == key) {
                let mut token = OsString::from(format!("--{key}="));
                token.push(value);
                expanded.push(token);
            } else if let Some(file) = &file
                && !is_set(arg, set_below)
                && !is_excluded(below, arg, set_below)
            {
                let tokens = file.tokens(&names, arg)?;
                added.extend((!tokens.is_empty()).then(|| key.to_owned()));
                expanded.extend(tokens);
            }
        }
        inherited.extend(command.get_arguments().filter(|arg| arg.is_global_set()).cloned());
        (command, set) = (below, set_below);
    }
    expanded.extend_from_slice(rest);
    Ok(Expanded { line: expanded, path: file.map(|file| file.path), added })
}

/// A table of all options of a command with their values and origins; `rest` stands for its command line.
/// Errors: those of [`expand`]; an unknown command; values that the command would refuse.
pub fn show(
    root: &Command,
    names: &[String],
    rest: &[OsString],
    path: Option<PathBuf>,
) -> Result<String> {
    let mut command = root;
    for name in names {
        let below = command.find_subcommand(name);
        let nearest = || nearest(name, command.get_subcommands().map(Command::get_name));
        command = below
            .ok_or_else(|| CliError::Input(format!("there is no command {name:?}{}", nearest())))?;
    }
    let words = names.iter().map(OsString::from).chain(rest.iter().cloned());
    let line: Vec<OsString> = [OsString::from(PROGRAM)].into_iter().chain(words).collect();
    let matches = lenient(root, &line).map_err(|error| CliError::Input(error.to_string()))?;
    let path = path.or_else(|| path_in(&matches));
    check_values(root, &line, path.as_ref())?;
    let file = path.map(|path| File::read(root, path)).transpose()?;
    let mut set = &matches;
    while let Some((_, below)) = set.subcommand() {
        set = below;
    }
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let mut lines = vec![format!("{:24}{:40}from", "option", "value")];
    for arg in options(command).filter(|arg| !arg.is_hide_set()) {
        let (value, from) = setting(arg, set, file.as_ref(), &names);
        let secret = arg.is_hide_env_values_set() && from != DEFAULT;
        let value = if secret { "(hidden)".to_owned() } else { value };
        lines.push(format!("{:24}{value:40}{from}", arg.get_long().unwrap_or_default()));
    }
    Ok(lines.join("\n"))
}

/// Refuses values of a line and of its configuration file as the command itself would. Required options may be missing.
fn check_values(root: &Command, line: &[OsString], path: Option<&PathBuf>) -> Result<()> {
    let config = path.map(|path| [OsString::from(format!("--{CONFIG}")), path.into()]);
    let (program, rest) = line.split_at(line.len().min(1));
    let line =
        program.iter().cloned().chain(config.into_iter().flatten()).chain(rest.iter().cloned());
    let expanded = expand(root, line.collect())?;
    let Err(error) = root.clone().try_get_matches_from(&expanded.line) else { return Ok(()) };
    let refused = [
        ErrorKind::ArgumentConflict,
        ErrorKind::InvalidUtf8,
        ErrorKind::InvalidValue,
        ErrorKind::TooManyValues,
        ErrorKind::ValueValidation,
        ErrorKind::WrongNumberOfValues,
    ];
    if !refused.contains(&error.kind()) {
        return Ok(());
    }
    let text = error.to_string();
    let text = text.lines().next().unwrap_or_default().trim_start_matches("error: ");
    let origin = expanded.origin_of(&error).map_or(String::new(), |origin| format!("; {origin}"));
    Err(CliError::Input(format!("{text}{origin}")))
}

/// Origin of an option that is not set.
const DEFAULT: &str = "the default";

/// Value and origin of an option.
fn setting(arg: &Arg, set: &ArgMatches, file: Option<&File>, names: &[&str]) -> (String, String) {
    let joined = |values: &mut dyn Iterator<Item = &OsStr>| {
        values.map(OsStr::to_string_lossy).collect::<Vec<_>>().join(",")
    };
    if is_set(arg, set) {
        let value = joined(&mut set.get_raw(arg.get_id().as_str()).into_iter().flatten());
        let variable = arg.get_env().map(OsStr::to_string_lossy).unwrap_or_default();
        let from = match set.value_source(arg.get_id().as_str()) {
            Some(ValueSource::EnvVariable) => format!("the variable {variable}"),
            _ => "the command line".to_owned(),
        };
        return (value, from);
    }
    let key = arg.get_long().unwrap_or_default();
    if let Some(file) = file
        && let Some(value) = file.value(names, key)
    {
        return (texts(value).unwrap_or_default().join(","), file.path.display().to_string());
    }
    let value = joined(&mut arg.get_default_values().iter().map(AsRef::as_ref));
    (if value.is_empty() { "-".to_owned() } else { value }, DEFAULT.to_owned())
}

/// Parses the valid part of a line, so that it also works while required options are missing.
fn lenient(root: &Command, line: &[OsString]) -> Result<ArgMatches, clap::Error> {
    root.clone().ignore_errors(true).try_get_matches_from(line)
}

/// The path of the configuration file. A global option is found at the innermost command.
fn path_in(matches: &ArgMatches) -> Option<PathBuf> {
    let path = matches.try_get_one::<PathBuf>(CONFIG).ok().flatten();
    let path = path.filter(|path| !path.as_os_str().is_empty()).cloned();
    matches.subcommand().and_then(|(_, below)| path_in(below)).or(path)
}

/// Number of words up to and including the name of a subcommand. The parser knows no subcommands here. Clap therefore
/// takes the first word that is not an option for an external program, and the following words for its arguments.
fn end_of_name(command: &Command, inherited: &[Arg], words: &[OsString]) -> Option<usize> {
    let arguments = command.get_arguments().chain(inherited).cloned();
    let outer = Command::new("outer")
        .no_binary_name(true)
        .args(arguments.map(|arg| arg.required(false)))
        .allow_external_subcommands(true)
        .ignore_errors(true);
    let matches = outer.try_get_matches_from(words).ok()?;
    let (_, arguments) = matches.subcommand()?;
    Some(words.len() - arguments.get_many::<OsString>("").map_or(0, Iterator::count))
}

/// Options with a long name.
fn options(command: &Command) -> impl Iterator<Item = &Arg> {
    command.get_arguments().filter(|arg| arg.get_long().is_some() && !arg.is_global_set())
}

fn option<'a>(command: &'a Command, key: &str) -> Option<&'a Arg> {
    options(command).find(|arg| arg.get_long() == Some(key))
}

/// True if the command line or the environment sets an option.
fn is_set(arg: &Arg, set: &ArgMatches) -> bool {
    let source = set.value_source(arg.get_id().as_str());
    matches!(source, Some(ValueSource::CommandLine | ValueSource::EnvVariable))
}

fn is_on_line(arg: &Arg, set: &ArgMatches) -> bool {
    set.value_source(arg.get_id().as_str()) == Some(ValueSource::CommandLine)
}

/// Options that stand before the name of a command but belong to it, with their values.
fn passed_on(command: &Command, set: &ArgMatches) -> Vec<(String, OsString)> {
    let is_root = command.get_name() == PROGRAM;
    let on_line = options(command).filter(|arg| is_root && is_on_line(arg, set));
    let value = |arg: &Arg| set.get_raw(arg.get_id().as_str())?.next_back().map(OsStr::to_owned);
    on_line.filter_map(|arg| Some((arg.get_long()?.to_owned(), value(arg)?))).collect()
}

/// Name of the root command.
const PROGRAM: &str = "sci-recon";

/// True if an option that is set excludes this one.
fn is_excluded(command: &Command, arg: &Arg, set: &ArgMatches) -> bool {
    let conflict = |a: &Arg, b: &Arg| {
        command.get_arg_conflicts_with(a).iter().any(|other| other.get_id() == b.get_id())
    };
    options(command)
        .filter(|other| is_set(other, set))
        .any(|other| conflict(arg, other) || conflict(other, arg))
}

/// A configuration file with valid keys.
#[derive(Debug)]
struct File {
    path: PathBuf,
    table: Table,
}

impl File {
    /// Errors: a file that can't be read, or isn't TOML; unknown keys.
    fn read(root: &Command, path: PathBuf) -> Result<Self> {
        let refused = |text: &dyn std::fmt::Display| {
            CliError::Input(format!("the configuration file {}: {text}", path.display()))
        };
        let text = fs::read_to_string(&path).map_err(|error| refused(&error))?;
        let table: Table = text.parse().map_err(|error: toml::de::Error| refused(&error))?;
        check(&table, root, "").map_err(|fault| refused(&fault))?;
        Ok(Self { path, table })
    }

    /// The value of an option of a command, from the innermost table that has it.
    fn value(&self, names: &[&str], key: &str) -> Option<&Value> {
        let mut tables = vec![&self.table];
        for name in names {
            let below = tables.last()?.get(*name).and_then(Value::as_table);
            let Some(below) = below else { break };
            tables.push(below);
        }
        let has_value = |table: &&Table| table.get(key).is_some_and(|value| !value.is_table());
        tables.into_iter().rev().find(has_value).and_then(|table| table.get(key))
    }

    /// The words of an option on a command line. Empty if the file has no value for it.
    /// Errors: a value of the wrong type.
    fn tokens(&self, names: &[&str], arg: &Arg) -> Result<Vec<OsString>> {
        let key = arg.get_long().unwrap_or_default();
        let Some(value) = self.value(names, key) else { return Ok(Vec::new()) };
        let wrong = |wanted: &str| {
            let path = self.path.display();
            CliError::Input(format!("the configuration file {path}: {key} must be {wanted}"))
        };
        if matches!(arg.get_action(), ArgAction::SetTrue) {
            let flag = value.as_bool().ok_or_else(|| wrong("true or false"))?;
            return Ok(flag.then(|| format!("--{key}").into()).into_iter().collect());
        }
        let texts = texts(value).ok_or_else(|| wrong("a text, a number or a list of them"))?;
        if value.is_array() && !matches!(arg.get_action(), ArgAction::Append) {
            return Err(wrong("one value"));
        }
        Ok(texts.into_iter().map(|text| format!("--{key}={text}").into()).collect())
    }
}

/// Refuses keys that no command below `command` has. `heading` is the name of the table.
fn check(table: &Table, command: &Command, heading: &str) -> Result<(), String> {
    for (key, value) in table {
        if let (Some(below), Some(inner)) = (command.find_subcommand(key), value.as_table()) {
            let heading = if heading.is_empty() { key.clone() } else { format!("{heading}.{key}") };
            check(inner, below, &heading)?;
            continue;
        }
        let keys = keys(command);
        if command.find_subcommand(key).is_some() && !keys.contains(&key.as_str()) {
            let place = if heading.is_empty() { key.clone() } else { format!("{heading}.{key}") };
            return Err(format!("{place} is a command: write its options below a line [{place}]"));
        }
        if value.is_table() {
            let names = command.get_subcommands().map(Command::get_name);
            return Err(format!("there is no command {key:?}{}", nearest(key, names)));
        }
        if !keys.contains(&key.as_str()) {
            let subject = match heading {
                "" => "no command has an".to_owned(),
                heading => format!("{heading} has no"),
            };
            return Err(format!("{subject} option {key:?}{}", nearest(key, keys.into_iter())));
        }
    }
    Ok(())
}

/// Long names of the options of a command and of those below it.
fn keys(command: &Command) -> Vec<&str> {
    let direct = options(command).filter_map(Arg::get_long);
    direct.chain(command.get_subcommands().flat_map(keys)).collect()
}

/// A suggestion for an invalid name.
fn nearest<'a>(name: &str, valid: impl Iterator<Item = &'a str>) -> String {
    let scored = valid.map(|valid| (strsim::jaro(name, valid), valid));
    let best = scored.max_by(|(a, _), (b, _)| a.total_cmp(b));
    let similar = best.filter(|(score, _)| *score >= SIMILAR);
    similar.map_or(String::new(), |(_, valid)| format!("; did you mean {valid:?}?"))
}

/// The values as text. `None` for types that no option accepts.
fn texts(value: &Value) -> Option<Vec<String>> {
    match value {
        Value::String(text) => Some(vec![text.clone()]),
        Value::Integer(number) => Some(vec![number.to_string()]),
        Value::Float(number) => Some(vec![number.to_string()]),
        Value::Boolean(flag) => Some(vec![flag.to_string()]),
        Value::Array(values) => {
            Some(values.iter().map(texts).collect::<Option<Vec<_>>>()?.concat())
        }
        Value::Table(_) | Value::Datetime(_) => None,
    }
}

#[cfg(test)]
mod tests {
    use std::ffi::OsString;
    use std::fs;

    use clap::{Arg, ArgAction, Command, value_parser};
    use std::path::PathBuf;

    use super::{expand, show};

    fn root() -> Command {
        let data = || Arg::new("data").long("data");
        let config = Arg::new("config").long("config").global(true);
        let serve = Command::new("serve")
            .arg(data())
            .arg(Arg::new("open").long("open").action(ArgAction::SetTrue))
            .arg(Arg::new("hosts").long("host").action(ArgAction::Append))
            .arg(Arg::new("masks").long("masks").conflicts_with("calibration"))
            .arg(Arg::new("calibration").long("calibration"))
            .arg(Arg::new("most").long("most").default_value("7").env("SCI_TEST_MOST"));
        let create = Command::new("create").arg(Arg::new("lab").long("lab"));
        Command::new("sci-recon")
            .arg(config.value_parser(value_parser!(PathBuf)))
            .arg(Arg::new("url").long("url"))
            .subcommand(serve)
            .subcommand(Command::new("worker").arg(Arg::new("nats").long("nats")))
            .subcommand(Command::new("token").arg(data().required(true)).subcommand(create))
            .subcommand(Command::new("ls").arg(Arg::new("url").long("url").env("SCI_TEST_URL")))
    }

    /// Expands a line in which `FILE` stands for the path of a file with this text.
    fn with_file(text: &str, line: &[&str]) -> Result<Vec<String>, String> {
        let folder = tempfile::tempdir().unwrap();
        // The file has the same name as a command.
        let file = folder.path().join("worker");
        fs::write(&file, text).unwrap();
        let file = file.to_str().unwrap();
        let words = ["sci-recon"].iter().chain(line).map(|word| word.replace("FILE", file));
        let line = words.map(OsString::from).collect();
        let expanded = expand(&root(), line).map_err(|error| error.to_string())?;
        let words = expanded.line.iter().skip(1).map(|word| word.to_str().unwrap().to_owned());
        Ok(words.filter(|word| !word.contains(file)).collect())
    }

    fn with(text: &str, line: &[&str]) -> Result<Vec<String>, String> {
        with_file(text, &[&["--config=FILE"], line].concat())
    }

    #[test]
    fn the_file_supplies_options_that_are_not_set() {
        let file = "data = \"/a\"\n[serve]\nopen = true\nhost = [\"x\", \"y\"]\nmost = 9\n";
        let serve = with(file, &["serve"]).unwrap();
        assert_eq!(serve, ["serve", "--data=/a", "--open", "--host=x", "--host=y", "--most=9"]);
        assert_eq!(with(file, &["token", "create"]).unwrap(), ["token", "--data=/a", "create"]);
        assert_eq!(with(file, &["worker"]).unwrap(), ["worker"], "worker has none of these");
        let line = ["serve", "--data", "/b", "--most=3", "--host=z", "--open"];
        assert_eq!(with(file, &line).unwrap(), line, "the command line takes precedence");
        assert_eq!(with("[serve]\nopen = false", &["serve"]).unwrap(), ["serve"]);
    }

    #[test]
    fn the_innermost_table_wins() {
        let file =
            "lab = \"top\"\ndata = \"/a\"\n[token]\ndata = \"/c\"\n[token.create]\nlab = \"in\"";
        let line = with(file, &["token", "create"]).unwrap();
        assert_eq!(line, ["token", "--data=/c", "create", "--lab=in"]);
        let file = "data = \"/a\"\n[token]\nlab = \"outer\"";
        let line = with(file, &["token", "--data", "create", "create"]).unwrap();
        assert_eq!(line, ["token", "--data", "create", "create", "--lab=outer"]);
    }

    #[test]
    fn values_that_equal_a_command_are_values() {
        let file = "[serve]\ndata = \"/a\"\n[worker]\nnats = \"n\"";
        for line in [
            &["--config", "FILE", "serve"][..],
            &["--config=FILE", "serve"],
            &["serve", "--config", "FILE"],
            &["--url", "worker", "--config", "FILE", "serve"],
            &["serve", "--most", "worker", "--config=FILE"],
        ] {
            let expanded = with_file(file, line);
            if line[0] == "--url" {
                assert!(expanded.unwrap_err().contains("serve takes no --url"));
                continue;
            }
            let expanded = expanded.unwrap();
            assert!(expanded.contains(&"--data=/a".to_owned()), "{line:?}: {expanded:?}");
            assert!(!expanded.contains(&"--nats=n".to_owned()), "{line:?}: {expanded:?}");
        }
        assert_eq!(
            with(file, &["serve", "--data", "worker"]).unwrap(),
            ["serve", "--data", "worker"]
        );
    }

    #[test]
    fn options_before_a_command_are_passed_on() {
        let line = with("url = \"file\"", &["--url", "x", "ls"]).unwrap();
        assert_eq!(line, ["--url", "x", "ls", "--url=x"]);
        let line = with("url = \"file\"", &["--url", "x", "ls", "--url", "y"]).unwrap();
        assert_eq!(line, ["--url", "x", "ls", "--url", "y"]);
        assert_eq!(with("url = \"file\"", &["ls"]).unwrap(), ["ls", "--url=file"]);
    }

    #[test]
    fn an_option_of_the_line_drops_those_it_excludes() {
        let file = "[serve]\nmasks = \"m.npy\"";
        assert_eq!(with(file, &["serve"]).unwrap(), ["serve", "--masks=m.npy"]);
        let line = ["serve", "--calibration", "c"];
        assert_eq!(with(file, &line).unwrap(), line);
    }

    #[test]
    fn an_error_in_the_file_names_the_key() {
        for (text, expected) in [
            ("dat = 1", "no command has an option \"dat\"; did you mean \"data\"?"),
            ("[serve]\nlist = 1", "serve has no option \"list\""),
            ("[serve]\nmots = 1", "serve has no option \"mots\"; did you mean \"most\"?"),
            (
                "[token.create]\nlabs = 1",
                "token.create has no option \"labs\"; did you mean \"lab\"?",
            ),
            ("serve = 1", "serve is a command: write its options below a line [serve]"),
            ("[token]\ncreate = 1", "write its options below a line [token.create]"),
            ("[server]\nmost = 1", "there is no command \"server\"; did you mean \"serve\"?"),
            ("[serve]\nmost = 2001-01-01", "most must be a text, a number"),
            ("[serve]\nmost = [1, 2]", "most must be one value"),
            ("[serve]\nopen = \"yes\"", "open must be true or false"),
            ("config = \"x\"", "no command has an option \"config\""),
            ("most", "TOML"),
        ] {
            let error = with(text, &["serve"]).unwrap_err();
            assert!(
                error.contains(expected) && error.contains("the configuration file /"),
                "{error}"
            );
        }
        let line = ["sci-recon", "--config", "/nowhere/x.toml", "serve"].map(OsString::from);
        assert!(expand(&root(), line.into()).unwrap_err().to_string().contains("/nowhere/x.toml"));
    }

    #[test]
    fn an_invalid_value_is_traced_to_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("sci.toml");
        fs::write(&file, "[serve]\nmost = \"many\"").unwrap();
        let number = |arg: Arg| arg.value_parser(value_parser!(u32));
        let root = root().mut_subcommand("serve", |serve| serve.mut_arg("most", number));
        let line = ["sci-recon", "serve", "--config", file.to_str().unwrap()].map(OsString::from);
        let expanded = expand(&root, line.into()).unwrap();
        let error = root.clone().try_get_matches_from(&expanded.line).unwrap_err();
        let text = expanded.origin_of(&error).unwrap();
        assert!(text.starts_with("most is set by") && text.contains("sci.toml"), "{text}");
    }

    #[test]
    fn the_table_shows_the_origin_of_each_value() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("sci.toml");
        fs::write(&file, "data = \"/a\"\nlab = \"l\"").unwrap();
        let shown = |names: &[&str], rest: &[&str]| {
            let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
            let rest: Vec<OsString> = rest.iter().map(OsString::from).collect();
            show(&root(), &names, &rest, Some(file.clone())).unwrap()
        };
        let text = shown(&["serve"], &["--open", "--host", "a", "--host=b"]);
        let line = |key: &str| {
            let row = text.lines().find(|line| line.starts_with(key)).unwrap();
            row.split_whitespace().map(str::to_owned).collect::<Vec<_>>()
        };
        assert_eq!(line("data"), ["data", "/a", file.to_str().unwrap()]);
        assert_eq!(line("open"), ["open", "true", "the", "command", "line"]);
        assert_eq!(line("most"), ["most", "7", "the", "default"]);
        assert_eq!(line("host"), ["host", "a,b", "the", "command", "line"]);
        assert_eq!(line("masks"), ["masks", "-", "the", "default"]);
        assert!(shown(&["token", "create"], &[]).contains("lab                     l  "));
        fs::write(&file, "most = \"many\"").unwrap();
        let number = |arg: Arg| arg.value_parser(value_parser!(u32));
        let root_with_number =
            root().mut_subcommand("serve", |serve| serve.mut_arg("most", number));
        let serve = ["serve".to_owned()];
        let refused =
            show(&root_with_number, &serve, &[], Some(file.clone())).unwrap_err().to_string();
        assert!(refused.contains("many") && refused.contains("sci.toml"), "{refused}");
        let refused = show(&root_with_number, &serve, &["--most=x".into()], None).unwrap_err();
        assert!(refused.to_string().contains("--most"), "{refused}");
        let error = show(&root(), &["sreve".to_owned()], &[], None).unwrap_err().to_string();
        assert!(error.contains("did you mean \"serve\"?"), "{error}");
    }
}

//! Options of the command line in place of the fields of the API that findings and errors name.

use engine::job::FindingCode;
use optics::Subject;

/// The file that a field belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Role {
    Masks,
    Measurement,
}

/// Fields of both roles. The option of the masks is `--masks-` and the name, that of the measurement the name alone.
const SHARED: [&str; 6] = ["array", "axes", "crop", "frames", "full_scale", "packing"];
/// Fields with one option.
const SINGLE: [&str; 6] =
    ["dark", "saturation", "bad_pixels", "mosaic", "sequence", "registration"];

fn option(name: &str, role: Role) -> String {
    let name = name.replace('_', "-");
    if role == Role::Masks { format!("`--masks-{name}`") } else { format!("`--{name}`") }
}

/// A text that names options in place of fields. `role` is the file that it is about, unless the text names it.
pub(super) fn as_options(text: &str, role: Role) -> String {
    let mut text = text.to_owned();
    for name in SHARED {
        let field = format!("`{name}`");
        let masks = option(name, Role::Masks);
        text = text.replace(&format!("{field} of the masks"), &format!("{masks} of the masks"));
        if name != "frames" || role == Role::Masks {
            text = text.replace(&field, &option(name, role));
        }
    }
    SINGLE.iter().fold(text, |text, name| {
        text.replace(&format!("`{name}`"), &option(name, Role::Measurement))
    })
}

/// The file that a finding is about.
pub(super) fn role_of(code: &str) -> Role {
    let code: Option<FindingCode> = code.parse().ok();
    match code.map(|code| code.entry().subjects) {
        Some([Subject::Calibration]) => Role::Masks,
        _ => Role::Measurement,
    }
}

#[cfg(test)]
mod tests {
    use clap::{Args, Command};
    use engine::job::FindingCode;
    use strum::VariantArray;

    use super::{Role, SHARED, SINGLE, as_options, option};
    use crate::cli::{reconstruct, submit};

    #[test]
    fn texts_name_the_option_of_their_file() {
        let text = "state the `full_scale` of the masks, or the `axes` and the `dark`";
        assert_eq!(
            as_options(text, Role::Measurement),
            "state the `--masks-full-scale` of the masks, or the `--axes` and the `--dark`"
        );
        assert_eq!(as_options("name it as `array`", Role::Masks), "name it as `--masks-array`");
    }

    #[test]
    fn the_options_exist_in_both_commands() {
        let commands = [
            submit::Arguments::augment_args(Command::new("submit")),
            reconstruct::Arguments::augment_args(Command::new("reconstruct")),
        ];
        for command in commands {
            let exists = |name: &str, role| {
                let option = option(name, role);
                let option = option.trim_matches(['`', '-']);
                command.get_arguments().any(|argument| argument.get_long() == Some(option))
            };
            for name in SHARED {
                assert!(exists(name, Role::Masks), "{name}");
                assert!(name == "frames" || exists(name, Role::Measurement), "{name}");
            }
            assert!(SINGLE.iter().all(|name| exists(name, Role::Measurement)));
        }
    }

    /// Fields in remedies that no option replaces are those of captures.
    #[test]
    fn remedies_name_no_field_that_the_command_line_lacks() {
        const OTHERS: [&str; 8] = [
            "`black_with_mask`",
            "`black`",
            "`bad`",
            "`frame-column-row`",
            "`frame-row-column`",
            "`serve --workers N`",
            "`sci-recon worker`",
            "`frames`",
        ];
        for code in FindingCode::VARIANTS {
            let mut remedy = as_options(code.entry().remedy, super::role_of(code.as_str()));
            OTHERS.iter().for_each(|word| remedy = remedy.replace(word, ""));
            let fields: Vec<&str> = remedy.split('`').skip(1).step_by(2).collect();
            assert!(fields.iter().all(|field| field.starts_with("--")), "{code}: {fields:?}");
        }
    }
}

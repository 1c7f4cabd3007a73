//! Prints to standard output. No other module does.

use std::fmt::Display;
use std::io::{ErrorKind, Write};

use super::CliError;
use super::error::Result;

/// Prints text without a line feed.
/// Errors: [`CliError::Unread`] if the reader, such as `head`, has closed the pipe.
pub(super) fn print_text(text: impl Display) -> Result<()> {
    let mut stdout = std::io::stdout().lock();
    write!(stdout, "{text}").and_then(|()| stdout.flush()).map_err(|error| match error.kind() {
        ErrorKind::BrokenPipe => CliError::Unread,
        _ => CliError::Failure(format!("cannot write to standard output: {error}")),
    })
}

/// Prints text and a line feed.
/// Errors: those of [`print_text`].
pub(super) fn print_line(text: impl Display) -> Result<()> {
    print_text(format_args!("{text}\n"))
}

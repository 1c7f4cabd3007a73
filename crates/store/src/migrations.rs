//! The schema of the database, which is part of the program as a list of migrations.

use std::borrow::Cow;

use sqlx::migrate::{MigrateError, Migration, MigrationType, Migrator};
use sqlx::{SqlSafeStr, SqlitePool};

/// Number, name and text of every migration, in order.
const MIGRATIONS: &[(i64, &str, &str)] = &[
    (1, "baseline", include_str!("../../../migrations/0001_baseline.sql")),
    (2, "rates of devices", include_str!("../../../migrations/0002_rates_of_devices.sql")),
];

/// Name of the first migration before version 0.1.0, whose databases this program does not read.
pub const BEFORE_BASELINE: &str = "init";

/// The migrations that lead from an empty database to the one that this program serves.
#[derive(Debug)]
pub struct Schema(Migrator);

impl Schema {
    pub fn current() -> Self {
        Self::with(MIGRATIONS.iter().copied())
    }

    fn with(migrations: impl Iterator<Item = (i64, &'static str, &'static str)>) -> Self {
        let simple = MigrationType::Simple;
        let migration = |(number, name, text): (i64, &'static str, &'static str)| {
            Migration::new(number, Cow::Borrowed(name), simple, text.into_sql_str(), false)
        };
        Self(Migrator::with_migrations(migrations.map(migration).collect()))
    }

    /// The schema of the baseline.
    #[cfg(test)]
    pub fn first() -> Self {
        Self::with(MIGRATIONS.iter().copied().take(1))
    }

    /// The schema of a version that has one more migration.
    #[cfg(test)]
    pub fn next(text: &'static str) -> Self {
        let next = (Self::current().newest() + 1, "next", text);
        Self::with(MIGRATIONS.iter().copied().chain([next]))
    }

    /// The number of the newest migration.
    pub fn newest(&self) -> i64 {
        self.0.iter().map(|migration| migration.version).max().unwrap_or_default()
    }

    /// Applies the migrations that a database lacks.
    /// Errors: the database has a migration that is not part of this schema, or one fails.
    pub async fn apply(&self, database: &SqlitePool) -> Result<(), MigrateError> {
        self.0.run(database).await
    }
}

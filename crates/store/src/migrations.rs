//! The migrations, which are part of the program.

use std::borrow::Cow;

use sqlx::SqlSafeStr;
use sqlx::migrate::{Migration, MigrationType, Migrator};

/// Number, name and text of every migration, in order.
const MIGRATIONS: &[(i64, &str, &str)] = &[
    (1, "init", include_str!("../../../migrations/0001_init.sql")),
    (20, "lists", include_str!("../../../migrations/0020_lists.sql")),
    (21, "history", include_str!("../../../migrations/0021_history.sql")),
    (30, "labs", include_str!("../../../migrations/0030_labs.sql")),
    (31, "admission", include_str!("../../../migrations/0031_admission.sql")),
    (32, "totals", include_str!("../../../migrations/0032_totals.sql")),
    (50, "calibration tasks", include_str!("../../../migrations/0050_calibration_tasks.sql")),
    (60, "models", include_str!("../../../migrations/0060_models.sql")),
    (70, "preview", include_str!("../../../migrations/0070_preview.sql")),
    (80, "folder", include_str!("../../../migrations/0080_folder.sql")),
    (81, "one queue", include_str!("../../../migrations/0081_one_queue.sql")),
    (82, "labs", include_str!("../../../migrations/0082_labs.sql")),
    (90, "remote", include_str!("../../../migrations/0090_remote.sql")),
    (110, "sequences", include_str!("../../../migrations/0110_sequences.sql")),
    (120, "without tiles", include_str!("../../../migrations/0120_without_tiles.sql")),
    (130, "damage", include_str!("../../../migrations/0130_damage.sql")),
    (131, "limits", include_str!("../../../migrations/0131_limits.sql")),
    (132, "starved", include_str!("../../../migrations/0132_starved.sql")),
    (133, "clock", include_str!("../../../migrations/0133_clock.sql")),
    (140, "request keys", include_str!("../../../migrations/0140_request_keys.sql")),
    (150, "sessions", include_str!("../../../migrations/0150_sessions.sql")),
    (151, "lab totals", include_str!("../../../migrations/0151_lab_totals.sql")),
    (160, "axes", include_str!("../../../migrations/0160_axes.sql")),
    (165, "mosaic", include_str!("../../../migrations/0165_mosaic.sql")),
    (166, "assessment", include_str!("../../../migrations/0166_assessment.sql")),
    (170, "movies", include_str!("../../../migrations/0170_movies.sql")),
    (180, "checks", include_str!("../../../migrations/0180_checks.sql")),
    (181, "result bytes", include_str!("../../../migrations/0181_result_bytes.sql")),
    (190, "requests", include_str!("../../../migrations/0190_requests.sql")),
];

/// The number of the newest migration.
pub const fn newest() -> i64 {
    MIGRATIONS[MIGRATIONS.len() - 1].0
}

/// Brings a database up to date.
pub fn migrator() -> Migrator {
    let migration = |&(number, name, text): &(i64, &'static str, &'static str)| {
        Migration::new(
            number,
            Cow::Borrowed(name),
            MigrationType::Simple,
            text.into_sql_str(),
            false,
        )
    };
    Migrator::with_migrations(MIGRATIONS.iter().map(migration).collect())
}

//! The service as lab machines see it: the real program on a free port with a fresh folder.

#![allow(clippy::unwrap_used)] // tests may panic

mod access;
mod adaptive;
mod all_labs;
mod api;
mod app;
mod assessment;
mod audit;
mod calibration;
mod checks;
mod cli;
mod client_libraries;
mod clients;
#[cfg(feature = "nats")]
mod cluster;
mod colour;
mod commands;
mod conditions;
mod confinement;
mod contract;
mod copies;
mod crashes;
mod damage;
mod dashboard;
mod deep;
mod defects;
mod downloads;
mod exports;
mod faults;
mod formats;
mod gpu;
mod hangs;
mod hostile;
mod identity;
mod jobs;
mod learned;
mod limits;
mod load;
mod measurement_check;
mod pictures;
mod pipeline;
mod recipes;
mod registration;
mod resumable;
mod samples;
mod sequences;
mod spectral;
mod storm;
mod upgrade;
mod uploads;
mod watching;
mod webhooks;
mod white_level;
mod work;
mod wrong_inputs;

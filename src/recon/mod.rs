//! The reconstruction core: arrays in, arrays out.

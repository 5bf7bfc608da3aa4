//! models: under construction.

//! api: under construction.

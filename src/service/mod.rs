//! service: under construction.

//! lift: under construction.

//! jobs: under construction.

//! capture: under construction.

//! photos: under construction.

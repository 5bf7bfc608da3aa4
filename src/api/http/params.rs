//! Query parameters by name: every one typed, none unknown, none twice.

use std::{convert::Infallible, str::FromStr};

use axum::{
    extract::{FromRequestParts, Query},
    http::request::Parts,
};

use crate::error::{Error, Result};

/// The pairs of a query string (and text parts of a form), taken out one by one.
#[derive(Clone, Debug, Default)]
pub(super) struct Params {
    pairs: Vec<(String, String)>,
    asked: Vec<&'static str>,
}

impl<S: Sync> FromRequestParts<S> for Params {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Infallible> {
        let pairs = Query::<Vec<(String, String)>>::try_from_uri(&parts.uri)
            .map(|query| query.0)
            .unwrap_or_default();
        Ok(Self { pairs, asked: Vec::new() })
    }
}

impl Params {
    /// Adds a pair that came elsewhere than in the query string.
    pub(super) fn push(&mut self, name: &str, value: String) {
        self.pairs.push((name.to_owned(), value));
    }

    /// The value of `name`.
    pub(super) fn text(&mut self, name: &'static str) -> Result<Option<String>> {
        self.asked.push(name);
        let Some(first) = self.pairs.iter().position(|(key, _)| key == name) else {
            return Ok(None);
        };
        let (_, value) = self.pairs.swap_remove(first);
        if self.pairs.iter().any(|(key, _)| key == name) {
            return Err(Error::invalid(format!("{name} is given twice")));
        }
        Ok(Some(value))
    }

    /// Every value of `name`, in their order.
    pub(super) fn texts(&mut self, name: &'static str) -> Vec<String> {
        self.asked.push(name);
        let mine = |pair: &mut (String, String)| pair.0 == name;
        self.pairs.extract_if(.., mine).map(|(_, value)| value).collect()
    }

    /// The value of `name` as a number; `what` says which: "a whole number".
    pub(super) fn number<T: FromStr>(
        &mut self,
        name: &'static str,
        what: &str,
    ) -> Result<Option<T>> {
        self.text(name)?.map(|value| parse(name, &value, what)).transpose()
    }

    /// The value of `name` as a whole number of at least 0.
    pub(super) fn whole<T: FromStr>(&mut self, name: &'static str) -> Result<Option<T>> {
        self.number(name, "a whole number")
    }

    /// The value of `name` as `true` or `false`.
    pub(super) fn flag(&mut self, name: &'static str) -> Result<Option<bool>> {
        match self.text(name)?.as_deref() {
            None => Ok(None),
            Some("true" | "1" | "") => Ok(Some(true)),
            Some("false" | "0") => Ok(Some(false)),
            Some(other) => Err(wrong(name, other, "true or false")),
        }
    }

    /// The value of `name` as exactly `N` comma-separated numbers.
    pub(super) fn numbers<const N: usize>(
        &mut self,
        name: &'static str,
    ) -> Result<Option<[f64; N]>> {
        self.list(name, "numbers")
    }

    /// The value of `name` as exactly `N` comma-separated whole numbers of at least 0.
    pub(super) fn wholes<const N: usize>(
        &mut self,
        name: &'static str,
    ) -> Result<Option<[u32; N]>> {
        self.list(name, "whole numbers")
    }

    fn list<T: FromStr + Copy + Default, const N: usize>(
        &mut self,
        name: &'static str,
        what: &str,
    ) -> Result<Option<[T; N]>> {
        let Some(value) = self.text(name)? else { return Ok(None) };
        let count = value.split(',').count();
        if count != N {
            return Err(Error::invalid(format!(
                "{name} has {count} numbers; it must have {N}, separated by commas"
            )));
        }
        let mut numbers = [T::default(); N];
        for (number, text) in numbers.iter_mut().zip(value.split(',')) {
            *number = parse(name, text.trim(), what)?;
        }
        Ok(Some(numbers))
    }

    /// Refuses what nobody asked for.
    pub(super) fn finish(self) -> Result<()> {
        match self.pairs.iter().find(|(name, _)| name != "deadline_ms") {
            None => Ok(()),
            Some((name, _)) => {
                let shown: String = name.chars().take(40).collect();
                let known = match self.asked.as_slice() {
                    [] => "no parameters".to_owned(),
                    asked => asked.join(", "),
                };
                Err(Error::invalid(format!("unknown parameter {shown:?}; this call takes {known}")))
            }
        }
    }
}

fn parse<T: FromStr>(name: &str, value: &str, what: &str) -> Result<T> {
    value.parse().map_err(|_| wrong(name, value, what))
}

fn wrong(name: &str, value: &str, what: &str) -> Error {
    let shown: String = value.chars().take(40).collect();
    Error::invalid(format!("{name} is {shown:?}; it must be {what}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn params(pairs: &[(&str, &str)]) -> Params {
        let mut params = Params::default();
        for (name, value) in pairs {
            params.push(name, (*value).to_owned());
        }
        params
    }

    #[test]
    fn values_are_typed_and_messages_name_them() {
        let mut p = params(&[("width", "abc"), ("eye", "1,2"), ("up", "0, 1,x"), ("t", "0.5")]);
        let message = |e: Error| e.message().to_owned();
        assert_eq!(
            message(p.whole::<u32>("width").unwrap_err()),
            "width is \"abc\"; it must be a whole number"
        );
        assert!(message(p.numbers::<3>("eye").unwrap_err()).contains("has 2 numbers"));
        assert!(message(p.numbers::<3>("up").unwrap_err()).contains("\"x\""));
        assert_eq!(p.number::<f64>("t", "a number").unwrap(), Some(0.5));
        assert_eq!(p.whole::<u32>("height").unwrap(), None);
        p.finish().unwrap();
    }

    #[test]
    fn a_list_takes_every_value_in_order_and_leaves_the_rest() {
        let mut p = params(&[("label", "cup"), ("x", "1"), ("label", "a table")]);
        assert_eq!(p.texts("label"), ["cup", "a table"]);
        assert_eq!(p.texts("label"), [""; 0]);
        assert_eq!(p.whole::<u32>("x").unwrap(), Some(1));
        p.finish().unwrap();
    }

    #[test]
    fn unknown_and_doubled_parameters_are_refused() {
        let mut p = params(&[("width", "1"), ("width", "2")]);
        assert!(p.whole::<u32>("width").is_err(), "two widths");
        let mut p = params(&[("widht", "1"), ("deadline_ms", "5")]);
        p.whole::<u32>("width").unwrap();
        let error = p.finish().unwrap_err();
        assert!(error.message().contains("widht") && error.message().contains("width"));
    }
}

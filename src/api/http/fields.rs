//! The named values of one request, read by serde types: parameters of a query string, parts of a
//! form, fields of a JSON body.
//!
//! An unknown name, a name that is given twice and a value of another type are errors. The message
//! names the field, what was given and what it must be.

use std::{
    convert::Infallible,
    fmt::{self, Display},
    iter,
    str::FromStr,
};

use axum::{
    extract::{FromRequestParts, Query},
    http::request::Parts,
};
use serde::{
    Deserialize, Deserializer,
    de::{self, DeserializeOwned, IntoDeserializer, Visitor},
    forward_to_deserialize_any,
};

use crate::error::{Error, Result, short};

/// What was given for a name.
#[derive(Clone, Debug)]
enum Given {
    /// A JSON value that is no list and no object.
    Json(serde_json::Value),
    List(Vec<Self>),
    /// In their order; a name may be there twice.
    Object(Vec<(String, Self)>),
    /// Characters of a query string or form, which may stand for any of these.
    Characters(String),
}

macro_rules! visit_plain {
    ($($method:ident $type:ty;)+) => {$(
        fn $method<E>(self, value: $type) -> Result<Given, E> {
            Ok(Given::Json(value.into()))
        }
    )+};
}

impl<'de> Deserialize<'de> for Given {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        struct Any;
        impl<'de> Visitor<'de> for Any {
            type Value = Given;

            fn expecting(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
                to.write_str("JSON")
            }

            visit_plain! {
                visit_bool bool;
                visit_u64 u64;
                visit_i64 i64;
                visit_f64 f64;
                visit_str &str;
            }

            fn visit_unit<E>(self) -> Result<Given, E> {
                Ok(Given::Json(serde_json::Value::Null))
            }

            fn visit_seq<A: de::SeqAccess<'de>>(self, mut list: A) -> Result<Given, A::Error> {
                let all = iter::from_fn(|| list.next_element().transpose());
                all.collect::<Result<_, _>>().map(Given::List)
            }

            fn visit_map<A: de::MapAccess<'de>>(self, mut map: A) -> Result<Given, A::Error> {
                let all = iter::from_fn(|| map.next_entry().transpose());
                all.collect::<Result<_, _>>().map(Given::Object)
            }
        }
        from.deserialize_any(Any)
    }
}

impl Given {
    fn is_null(&self) -> bool {
        matches!(self, Self::Json(serde_json::Value::Null))
    }

    fn text(&self) -> Option<&str> {
        match self {
            Self::Json(value) => value.as_str(),
            Self::Characters(text) => Some(text),
            _ => None,
        }
    }
}

impl Display for Given {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self, self.text()) {
            (_, Some(text)) => write!(to, "{:?}", short(text)),
            (Self::Json(value), _) => value.fmt(to),
            (Self::List(_), _) => to.write_str("a list"),
            _ => to.write_str("an object"),
        }
    }
}

/// A sentence about a field.
#[derive(Debug)]
pub(super) struct FieldError(String);

impl Display for FieldError {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        to.write_str(&self.0)
    }
}

impl std::error::Error for FieldError {}

impl de::Error for FieldError {
    fn custom<T: Display>(message: T) -> Self {
        Self(message.to_string())
    }

    fn missing_field(name: &'static str) -> Self {
        Self(format!("{name} is missing"))
    }
}

fn refused(fault: FieldError) -> Error {
    Error::invalid(fault.0)
}

/// The values of a request that are not taken yet.
#[derive(Clone, Debug, Default)]
pub(super) struct Fields {
    given: Vec<(String, Given)>,
    /// Names that the call takes.
    known: Vec<&'static str>,
}

impl<S: Sync> FromRequestParts<S> for Fields {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Infallible> {
        let pairs = Query::<Vec<(String, String)>>::try_from_uri(&parts.uri);
        let mut pairs = pairs.map(|query| query.0).unwrap_or_default();
        // Every call takes it, and the middleware has read it.
        pairs.retain(|(name, _)| name != "deadline_ms");
        let mut fields = Self::default();
        pairs.into_iter().for_each(|(name, value)| fields.push(&name, value));
        Ok(fields)
    }
}

impl Fields {
    /// The fields of a JSON object.
    pub(super) fn of_json(json: &[u8]) -> Result<Self> {
        let given = serde_json::from_slice(json)
            .map_err(|e| Error::invalid(format!("body: not valid JSON: {e}")))?;
        match given {
            Given::Object(given) => Ok(Self { given, known: Vec::new() }),
            other => Err(Error::invalid(format!("body is {other}; it must be a JSON object"))),
        }
    }

    /// Adds characters that came elsewhere than in the query string.
    pub(super) fn push(&mut self, name: &str, value: String) {
        self.given.push((name.to_owned(), Given::Characters(value)));
    }

    /// Whether `name` is given and not taken yet.
    pub(super) fn has(&self, name: &str) -> bool {
        self.given.iter().any(|(given, _)| given == name)
    }

    /// Takes the fields of `T`.
    pub(super) fn take<T: DeserializeOwned>(&mut self) -> Result<T> {
        T::deserialize(self).map_err(refused)
    }

    /// Takes the value of `name`, where there is one.
    pub(super) fn value<T: DeserializeOwned>(&mut self, name: &'static str) -> Result<Option<T>> {
        self.known.push(name);
        let Some(given) = self.one(name).map_err(refused)? else { return Ok(None) };
        Option::deserialize(Value { path: name.to_owned(), given }).map_err(refused)
    }

    /// Takes every value of `name`, in their order.
    pub(super) fn all<T: DeserializeOwned>(&mut self, name: &'static str) -> Result<Vec<T>> {
        self.known.push(name);
        let mine = self.given.extract_if(.., |(given, _)| given == name);
        mine.map(|(_, given)| {
            T::deserialize(Value { path: name.to_owned(), given }).map_err(refused)
        })
        .collect()
    }

    /// Refuses names that are left.
    pub(super) fn finish(self) -> Result<()> {
        let Some((name, _)) = self.given.first() else { return Ok(()) };
        let mut known = self.known.clone();
        known.dedup();
        let known = match known.as_slice() {
            [] => "no parameters".to_owned(),
            known => known.join(", "),
        };
        Err(Error::invalid(format!("unknown parameter {:?}; this call takes {known}", short(name))))
    }

    fn one(&mut self, name: &str) -> Result<Option<Given>, FieldError> {
        let Some(first) = self.given.iter().position(|(given, _)| given == name) else {
            return Ok(None);
        };
        let (_, value) = self.given.remove(first);
        if self.has(name) {
            return Err(FieldError(format!("{name} is given twice")));
        }
        Ok(Some(value))
    }
}

/// Takes the fields that a struct has, and leaves the others.
impl<'de> Deserializer<'de> for &mut Fields {
    type Error = FieldError;

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        _name: &'static str,
        fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, FieldError> {
        self.known.extend(fields);
        let mut taken = Vec::new();
        for name in fields {
            // `null` and nothing are the same.
            if let Some(given) = self.one(name)?.filter(|given| !given.is_null()) {
                taken.push((*name, Value { path: (*name).to_owned(), given }));
            }
        }
        visitor.visit_map(de::value::MapDeserializer::new(taken.into_iter()))
    }

    fn deserialize_any<V: Visitor<'de>>(self, _visitor: V) -> Result<V::Value, FieldError> {
        Err(FieldError("fields are read as a struct".to_owned()))
    }

    forward_to_deserialize_any! {
        bool i8 i16 i32 i64 u8 u16 u32 u64 f32 f64 char str string bytes byte_buf option unit
        unit_struct newtype_struct seq tuple tuple_struct map enum identifier ignored_any
    }
}

/// A value and where it stands: `width`, `cameras[3]`.
struct Value {
    path: String,
    given: Given,
}

impl Value {
    fn must_be(&self, what: impl Display) -> FieldError {
        FieldError(format!("{} is {}; it must be {what}", self.path, self.given))
    }

    fn number<T: FromStr>(&self, what: &str) -> Result<T, FieldError> {
        let number = match &self.given {
            Given::Characters(text) => text.parse().ok(),
            Given::Json(serde_json::Value::Number(number)) => number.to_string().parse().ok(),
            _ => None,
        };
        number.ok_or_else(|| self.must_be(what))
    }
}

impl IntoDeserializer<'_, FieldError> for Value {
    type Deserializer = Self;

    fn into_deserializer(self) -> Self {
        self
    }
}

macro_rules! deserialize_numbers {
    ($($what:literal: $($method:ident $visit:ident),+;)+) => {$($(
        fn $method<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, FieldError> {
            visitor.$visit(self.number($what)?)
        }
    )+)+};
}

impl<'de> Deserializer<'de> for Value {
    type Error = FieldError;

    fn deserialize_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, FieldError> {
        let wrong = self.must_be(&visitor as &dyn de::Expected);
        let read: Result<V::Value, FieldError> = match (&self.given, self.given.text()) {
            (_, Some(text)) => visitor.visit_str(text),
            (Given::Json(serde_json::Value::Number(number)), _) if number.is_u64() => {
                visitor.visit_u64(number.as_u64().unwrap_or_default())
            }
            (Given::Json(serde_json::Value::Number(number)), _) => {
                visitor.visit_f64(number.as_f64().unwrap_or_default())
            }
            (Given::List(_), _) => self.deserialize_seq(visitor),
            _ => return Err(wrong),
        };
        read.map_err(|_| wrong)
    }

    fn deserialize_option<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, FieldError> {
        if self.given.is_null() { visitor.visit_none() } else { visitor.visit_some(self) }
    }

    fn deserialize_bool<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, FieldError> {
        let value = match &self.given {
            Given::Characters(text) => match text.as_str() {
                "true" | "1" | "" => Some(true),
                "false" | "0" => Some(false),
                _ => None,
            },
            Given::Json(value) => value.as_bool(),
            _ => None,
        };
        visitor.visit_bool(value.ok_or_else(|| self.must_be("true or false"))?)
    }

    deserialize_numbers! {
        "a whole number": deserialize_u16 visit_u16, deserialize_u32 visit_u32,
            deserialize_u64 visit_u64;
        "a number": deserialize_f32 visit_f32, deserialize_f64 visit_f64;
    }

    fn deserialize_str<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, FieldError> {
        visitor.visit_str(self.given.text().ok_or_else(|| self.must_be("a text"))?)
    }

    fn deserialize_string<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, FieldError> {
        self.deserialize_str(visitor)
    }

    fn deserialize_tuple<V: Visitor<'de>>(
        self,
        len: usize,
        visitor: V,
    ) -> Result<V::Value, FieldError> {
        let (parts, separated) = match self.given {
            Given::List(parts) => (parts, ""),
            Given::Characters(text) => {
                let part = |part: &str| Given::Characters(part.trim().to_owned());
                (text.split(',').map(part).collect(), ", separated by commas")
            }
            _ => return Err(self.must_be(format_args!("a list of {len} numbers"))),
        };
        let (path, count) = (self.path, parts.len());
        if count != len {
            let must = format!("it must have {len}{separated}");
            return Err(FieldError(format!("{path} has {count} numbers; {must}")));
        }
        let parts = parts.into_iter().map(|given| Self { path: path.clone(), given });
        visitor.visit_seq(de::value::SeqDeserializer::new(parts))
    }

    fn deserialize_seq<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, FieldError> {
        let Given::List(values) = self.given else { return Err(self.must_be("a list")) };
        let values = values.into_iter().enumerate();
        let values = values.map(|(i, given)| Self { path: format!("{}[{i}]", self.path), given });
        let mut list = de::value::SeqDeserializer::new(values);
        let read = visitor.visit_seq(&mut list)?;
        list.end()?;
        Ok(read)
    }

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        name: &'static str,
        names: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, FieldError> {
        let Given::Object(given) = self.given else { return Err(self.must_be("an object")) };
        let at = |fault: &dyn Display| FieldError(format!("{}: {fault}", self.path));
        let mut fields = Fields { given, known: Vec::new() };
        let value = fields.deserialize_struct(name, names, visitor).map_err(|e| at(&e))?;
        fields.finish().map_err(|e| at(&e.message()))?;
        Ok(value)
    }

    fn deserialize_enum<V: Visitor<'de>>(
        self,
        _name: &'static str,
        names: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, FieldError> {
        let names = match names {
            [first @ .., last] if !first.is_empty() => format!("{} or {last}", first.join(", ")),
            _ => names.join(", "),
        };
        let Some(text) = self.given.text() else { return Err(self.must_be(names)) };
        let text: de::value::StrDeserializer<'_, FieldError> = text.into_deserializer();
        visitor.visit_enum(text).map_err(|_| self.must_be(names))
    }

    forward_to_deserialize_any! {
        i8 i16 i32 i64 u8 char bytes byte_buf unit unit_struct newtype_struct tuple_struct map
        identifier ignored_any
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::{
        BackgroundSpec, Boxes, CameraFields, PictureKind, PictureOptions, ViewOptions,
    };

    // The messages are tested over HTTP, in `tests/it/fields.rs`.
    #[test]
    fn a_query_string_and_json_are_read_by_the_same_types() {
        let mut query = Fields::default();
        for (name, value) in [
            ("from", "1"),
            ("eye", "0, 1,2.5"),
            ("antialiased", ""),
            ("width", "8"),
            ("background", "#ff0000"),
            ("crop", "1,2,3,4"),
            ("format", "jpg"),
            ("label", "cup"),
            ("x", "1"),
            ("label", "a table"),
        ] {
            query.push(name, value.to_owned());
        }
        let camera: CameraFields = query.take().unwrap();
        assert_eq!((camera.from, camera.eye), (Some(1), Some([0.0, 1.0, 2.5])));
        let options: ViewOptions = query.take().unwrap();
        assert_eq!((options.width, options.antialiased), (Some(8), Some(true)));
        let picture: PictureOptions = query.take().unwrap();
        assert_eq!(picture.background, BackgroundSpec::Color([1.0, 0.0, 0.0]));
        assert_eq!(<[u32; 4]>::from(picture.crop.unwrap()), [1, 2, 3, 4]);
        assert_eq!(picture.format.to_string(), "jpeg");
        assert_eq!(query.all::<String>("label").unwrap(), ["cup", "a table"]);
        assert_eq!(query.value::<f64>("x").unwrap(), Some(1.0));
        query.finish().unwrap();

        let json = br#"{"cameras": [{"from": 0}, {"eye": [0, 0, 1.5], "up": null}],
            "kinds": ["mask"], "boxes": "none", "relevancy": true, "near": 1,
            "background": [0, 0.5, 1]}"#;
        let mut body = Fields::of_json(json).unwrap();
        let cameras: Vec<CameraFields> = body.value("cameras").unwrap().unwrap();
        assert_eq!((cameras[0].from, cameras[1].eye), (Some(0), Some([0.0, 0.0, 1.5])));
        assert_eq!(body.value::<Vec<PictureKind>>("kinds").unwrap(), Some(vec![PictureKind::Mask]));
        assert_eq!(body.value::<Boxes>("boxes").unwrap(), Some(Boxes::None));
        assert_eq!(body.value::<bool>("relevancy").unwrap(), Some(true));
        assert_eq!(body.take::<ViewOptions>().unwrap().near, Some(1.0));
        let picture: PictureOptions = body.take().unwrap();
        assert_eq!(picture.background, BackgroundSpec::Color([0.0, 0.5, 1.0]));
        body.finish().unwrap();
    }
}

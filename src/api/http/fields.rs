//! The named values of one request, read by serde types: parameters of a query string, parts of a
//! form, fields of a JSON body. Every value is typed, none is unknown, none is given twice; a
//! message names the field, what was given and what it must be.

use std::{convert::Infallible, fmt::Display, str::FromStr, time::Duration};

use axum::{
    extract::{FromRequestParts, Query},
    http::request::Parts,
};
use serde::{
    Deserialize, Deserializer,
    de::{self, DeserializeOwned, IntoDeserializer, Visitor},
    forward_to_deserialize_any,
};

use crate::error::{Error, Result};

/// What was given for a name.
#[derive(Clone, Debug)]
enum Given {
    Null,
    Bool(bool),
    Number(serde_json::Number),
    Text(String),
    List(Vec<Self>),
    Object(Vec<(String, Self)>),
    /// Characters of a query string or form, which may stand for any of these.
    Characters(String),
}

impl<'de> Deserialize<'de> for Given {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        struct Any;
        impl<'de> Visitor<'de> for Any {
            type Value = Given;

            fn expecting(&self, to: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                to.write_str("JSON")
            }

            fn visit_unit<E>(self) -> Result<Given, E> {
                Ok(Given::Null)
            }

            fn visit_bool<E>(self, value: bool) -> Result<Given, E> {
                Ok(Given::Bool(value))
            }

            fn visit_u64<E>(self, value: u64) -> Result<Given, E> {
                Ok(Given::Number(value.into()))
            }

            fn visit_i64<E>(self, value: i64) -> Result<Given, E> {
                Ok(Given::Number(value.into()))
            }

            fn visit_f64<E>(self, value: f64) -> Result<Given, E> {
                Ok(serde_json::Number::from_f64(value).map_or(Given::Null, Given::Number))
            }

            fn visit_str<E>(self, value: &str) -> Result<Given, E> {
                Ok(Given::Text(value.to_owned()))
            }

            fn visit_string<E>(self, value: String) -> Result<Given, E> {
                Ok(Given::Text(value))
            }

            fn visit_seq<A: de::SeqAccess<'de>>(self, mut list: A) -> Result<Given, A::Error> {
                let mut all = Vec::new();
                while let Some(value) = list.next_element()? {
                    all.push(value);
                }
                Ok(Given::List(all))
            }

            fn visit_map<A: de::MapAccess<'de>>(self, mut map: A) -> Result<Given, A::Error> {
                let mut all = Vec::new();
                while let Some(pair) = map.next_entry()? {
                    all.push(pair);
                }
                Ok(Given::Object(all))
            }
        }
        from.deserialize_any(Any)
    }
}

impl Display for Given {
    fn fmt(&self, to: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let short = |text: &str| text.chars().take(40).collect::<String>();
        match self {
            Self::Null => to.write_str("null"),
            Self::Bool(value) => value.fmt(to),
            Self::Number(value) => value.fmt(to),
            Self::Text(text) | Self::Characters(text) => write!(to, "{:?}", short(text)),
            Self::List(_) => to.write_str("a list"),
            Self::Object(_) => to.write_str("an object"),
        }
    }
}

/// A sentence about a field.
#[derive(Debug)]
pub(super) struct FieldError(String);

impl Display for FieldError {
    fn fmt(&self, to: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
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
        let mut fields = Self::default();
        pairs.map(|query| query.0).unwrap_or_default().into_iter().for_each(|(name, value)| {
            // Every call takes it; the edge has read it.
            if name != "deadline_ms" {
                fields.push(&name, value);
            }
        });
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
        Option::deserialize(Value { path: name, given }).map_err(refused)
    }

    /// Takes the value of `name` as a time in milliseconds.
    pub(super) fn millis(&mut self, name: &'static str) -> Result<Option<Duration>> {
        Ok(self.value(name)?.map(Duration::from_millis))
    }

    /// Takes every value of `name`, in their order.
    pub(super) fn all<T: DeserializeOwned>(&mut self, name: &'static str) -> Result<Vec<T>> {
        self.known.push(name);
        let mine = self.given.extract_if(.., |(given, _)| given == name);
        mine.map(|(_, given)| T::deserialize(Value { path: name, given }).map_err(refused))
            .collect()
    }

    /// Refuses what nobody took.
    pub(super) fn finish(self) -> Result<()> {
        let Some((name, _)) = self.given.first() else { return Ok(()) };
        let shown: String = name.chars().take(40).collect();
        let known = match self.known.as_slice() {
            [] => "no parameters".to_owned(),
            known => known.join(", "),
        };
        Err(Error::invalid(format!("unknown parameter {shown:?}; this call takes {known}")))
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
            if let Some(given) = self.one(name)?.filter(|given| !matches!(given, Given::Null)) {
                taken.push((*name, Value { path: name, given }));
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
struct Value<P> {
    path: P,
    given: Given,
}

impl<P: Display> Value<P> {
    fn must_be(&self, what: impl Display) -> FieldError {
        FieldError(format!("{} is {}; it must be {what}", self.path, self.given))
    }

    /// The characters of a query string or the number of a JSON body.
    fn number<T: FromStr>(
        &self,
        what: &str,
        of_json: impl FnOnce(&serde_json::Number) -> Option<T>,
    ) -> Result<T, FieldError> {
        let number = match &self.given {
            Given::Characters(text) => text.parse().ok(),
            Given::Number(number) => of_json(number),
            _ => None,
        };
        number.ok_or_else(|| self.must_be(what))
    }
}

impl<'de, P: Display> IntoDeserializer<'de, FieldError> for Value<P> {
    type Deserializer = Self;

    fn into_deserializer(self) -> Self {
        self
    }
}

const WHOLE: &str = "a whole number";

macro_rules! whole_numbers {
    ($($method:ident $type:ty, $visit:ident;)+) => {$(
        fn $method<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, FieldError> {
            let json = |number: &serde_json::Number| <$type>::try_from(number.as_u64()?).ok();
            visitor.$visit(self.number(WHOLE, json)?)
        }
    )+};
}

impl<'de, P: Display> Deserializer<'de> for Value<P> {
    type Error = FieldError;

    fn deserialize_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, FieldError> {
        let wrong = self.must_be(&visitor as &dyn de::Expected);
        let read: Result<V::Value, FieldError> = match self.given {
            Given::Text(text) | Given::Characters(text) => visitor.visit_string(text),
            Given::List(_) => self.deserialize_seq(visitor),
            _ => return Err(wrong),
        };
        read.map_err(|_| wrong)
    }

    fn deserialize_option<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, FieldError> {
        match self.given {
            Given::Null => visitor.visit_none(),
            _ => visitor.visit_some(self),
        }
    }

    fn deserialize_newtype_struct<V: Visitor<'de>>(
        self,
        _name: &'static str,
        visitor: V,
    ) -> Result<V::Value, FieldError> {
        visitor.visit_newtype_struct(self)
    }

    fn deserialize_bool<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, FieldError> {
        visitor.visit_bool(match &self.given {
            Given::Bool(value) => *value,
            Given::Characters(text) if ["true", "1", ""].contains(&text.as_str()) => true,
            Given::Characters(text) if ["false", "0"].contains(&text.as_str()) => false,
            _ => return Err(self.must_be("true or false")),
        })
    }

    whole_numbers! {
        deserialize_u16 u16, visit_u16;
        deserialize_u32 u32, visit_u32;
        deserialize_u64 u64, visit_u64;
    }

    fn deserialize_f32<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, FieldError> {
        #[expect(clippy::cast_possible_truncation, reason = "rounded, as the characters are")]
        let json = |number: &serde_json::Number| number.as_f64().map(|number| number as f32);
        visitor.visit_f32(self.number("a number", json)?)
    }

    fn deserialize_f64<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, FieldError> {
        visitor.visit_f64(self.number("a number", serde_json::Number::as_f64)?)
    }

    fn deserialize_string<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, FieldError> {
        match self.given {
            Given::Text(text) | Given::Characters(text) => visitor.visit_string(text),
            _ => Err(self.must_be("a text")),
        }
    }

    fn deserialize_str<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, FieldError> {
        self.deserialize_string(visitor)
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
        let parts = parts.into_iter().map(|given| Value { path: &path, given });
        visitor.visit_seq(de::value::SeqDeserializer::new(parts))
    }

    fn deserialize_seq<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, FieldError> {
        let Given::List(values) = self.given else { return Err(self.must_be("a list")) };
        let path = self.path;
        let values = values.into_iter().enumerate();
        // The path as text: a list in a list would be a type without end.
        let values = values.map(|(i, given)| Value { path: format!("{path}[{i}]"), given });
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
        let (Given::Text(text) | Given::Characters(text)) = &self.given else {
            return Err(self.must_be(names));
        };
        let text: de::value::StrDeserializer<'_, FieldError> = text.as_str().into_deserializer();
        visitor.visit_enum(text).map_err(|_| self.must_be(names))
    }

    forward_to_deserialize_any! {
        i8 i16 i32 i64 u8 char bytes byte_buf unit unit_struct tuple_struct map identifier
        ignored_any
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::{
        Background, Boxes, CameraFields, Kind, PageRequest, PictureOptions, ViewOptions,
    };

    fn query(pairs: &[(&str, &str)]) -> Fields {
        let mut fields = Fields::default();
        pairs.iter().for_each(|(name, value)| fields.push(name, (*value).to_owned()));
        fields
    }

    fn message<T: std::fmt::Debug>(result: Result<T>) -> String {
        result.expect_err("refused").message().to_owned()
    }

    #[test]
    fn a_query_string_is_read_by_types_and_messages_name_the_field() {
        let mut fields = query(&[
            ("from", "1"),
            ("eye", "0, 1,2.5"),
            ("antialiased", ""),
            ("width", "8"),
            ("background", "#ff0000"),
            ("crop", "1,2,3,4"),
            ("format", "jpg"),
        ]);
        let camera: CameraFields = fields.take().unwrap();
        assert_eq!((camera.from, camera.eye), (Some(1), Some([0.0, 1.0, 2.5])));
        let options: ViewOptions = fields.take().unwrap();
        assert_eq!((options.width, options.antialiased), (Some(8), true));
        let picture: PictureOptions = fields.take().unwrap();
        assert_eq!(picture.background, Background::Color([1.0, 0.0, 0.0]));
        assert_eq!(<[u32; 4]>::from(picture.crop.unwrap()), [1, 2, 3, 4]);
        assert_eq!(picture.format.to_string(), "jpeg");
        fields.finish().unwrap();

        let view = |name, value| message(query(&[(name, value)]).take::<ViewOptions>());
        assert_eq!(view("width", "abc"), "width is \"abc\"; it must be a whole number");
        assert_eq!(view("width", "4294967296").find("whole number"), Some(36));
        assert_eq!(view("quality", "best"), "quality is \"best\"; it must be exact or fast");
        let camera = |name, value| message(query(&[(name, value)]).take::<CameraFields>());
        let must = "it must have 3, separated by commas";
        assert_eq!(camera("eye", "1,2"), format!("eye has 2 numbers; {must}"));
        assert_eq!(camera("up", "0, 1,x"), "up is \"x\"; it must be a number");
        let picture = message(query(&[("background", "sky")]).take::<PictureOptions>());
        assert!(picture.starts_with("background is \"sky\"; it must be backdrop, "), "{picture}");
    }

    #[test]
    fn what_is_unknown_given_twice_or_missing_is_refused() {
        let mut fields = query(&[("limti", "1")]);
        fields.take::<PageRequest>().unwrap();
        let unknown = message(fields.finish());
        assert_eq!(unknown, "unknown parameter \"limti\"; this call takes limit, after");
        let twice = message(query(&[("limit", "1"), ("limit", "2")]).take::<PageRequest>());
        assert_eq!(twice, "limit is given twice");
        let mut labels = query(&[("label", "cup"), ("x", "1"), ("label", "a table")]);
        assert_eq!(labels.all::<String>("label").unwrap(), ["cup", "a table"]);
        assert_eq!(labels.value::<f64>("x").unwrap(), Some(1.0));
        labels.finish().unwrap();
    }

    #[test]
    fn json_is_read_by_the_same_types_without_a_word_of_rust() {
        let json = |json: &str| Fields::of_json(json.as_bytes()).unwrap();
        let mut body = json(
            r#"{"cameras": [{"from": 0}, {"eye": [0, 0, 1.5], "up": null}], "kinds": ["mask"],
                "boxes": "none", "relevancy": true, "near": 1, "background": [0, 0.5, 1]}"#,
        );
        let cameras: Vec<CameraFields> = body.value("cameras").unwrap().unwrap();
        assert_eq!((cameras[0].from, cameras[1].eye), (Some(0), Some([0.0, 0.0, 1.5])));
        assert_eq!(body.value::<Vec<Kind>>("kinds").unwrap(), Some(vec![Kind::Mask]));
        assert_eq!(body.value::<Boxes>("boxes").unwrap(), Some(Boxes::None));
        assert_eq!(body.value::<bool>("relevancy").unwrap(), Some(true));
        assert_eq!(body.take::<ViewOptions>().unwrap().near, Some(1.0));
        let picture: PictureOptions = body.take().unwrap();
        assert_eq!(picture.background, Background::Color([0.0, 0.5, 1.0]));
        body.finish().unwrap();

        let cameras = |value: &str| {
            let mut body = json(&format!("{{\"cameras\": {value}}}"));
            message(body.value::<Vec<CameraFields>>("cameras"))
        };
        assert_eq!(cameras("5"), "cameras is 5; it must be a list");
        assert_eq!(cameras("[{}, 7]"), "cameras[1] is 7; it must be an object");
        let index = "cameras[0]: from is -1; it must be a whole number";
        assert_eq!(cameras(r#"[{"from": -1}]"#), index);
        let eye = "cameras[0]: eye has 2 numbers; it must have 3";
        assert_eq!(cameras(r#"[{"eye": [1, 2]}]"#), eye);
        assert!(cameras(r#"[{"form": 1}]"#).starts_with("cameras[0]: unknown parameter \"form\""));
        assert_eq!(cameras(r#"[{"t": 1, "t": 2}]"#), "cameras[0]: t is given twice");
        let kinds = message(json(r#"{"kinds": ["smell"]}"#).value::<Vec<Kind>>("kinds"));
        let must = "color, depth, alpha, semantics, relevancy or mask";
        assert_eq!(kinds, format!("kinds[0] is \"smell\"; it must be {must}"));
        let texts = message(json(r#"{"texts": [1]}"#).value::<Vec<String>>("texts"));
        assert_eq!(texts, "texts[0] is 1; it must be a text");
        let four = message(json(r#"{"background": [0, 0, 0, 0]}"#).take::<PictureOptions>());
        assert!(four.starts_with("background is a list; it must be backdrop"), "{four}");
        assert_eq!(message(Fields::of_json(b"[1]")), "body is a list; it must be a JSON object");
        assert!(message(Fields::of_json(b"{")).starts_with("body: not valid JSON"));
    }
}

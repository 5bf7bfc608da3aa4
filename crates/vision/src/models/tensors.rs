//! A network as a caller from outside runs it: tensors by name.
//!
//! Whatever a network runs, its memory and time grow with the sizes of its tensors, and a number
//! can be an index into its weights. So a tensor must have the sizes and the numbers that the
//! program's own runs may have. [`TensorSpec`] says which.

use crate::error::{Error, Result, short};

/// Largest size of a dimension that neither file nor manifest bounds.
const FREE_MAX: usize = 64;

/// What the numbers of a tensor are. Halves of a file are f32 here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TensorKind {
    /// 32-bit floats.
    F32,
    /// Whole numbers of 64 bits.
    I64,
    /// Bytes.
    U8,
}

/// Numbers of a tensor, row-major.
#[derive(Clone, Debug, PartialEq)]
pub enum TensorData {
    /// 32-bit floats.
    F32(Vec<f32>),
    /// Whole numbers of 64 bits.
    I64(Vec<i64>),
    /// Bytes.
    U8(Vec<u8>),
}

impl TensorData {
    /// What its numbers are.
    #[must_use]
    pub fn kind(&self) -> TensorKind {
        match self {
            Self::F32(_) => TensorKind::F32,
            Self::I64(_) => TensorKind::I64,
            Self::U8(_) => TensorKind::U8,
        }
    }

    /// How many there are.
    #[must_use]
    pub fn len(&self) -> usize {
        match self {
            Self::F32(data) => data.len(),
            Self::I64(data) => data.len(),
            Self::U8(data) => data.len(),
        }
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// A tensor with its name.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// Name in the network.
    pub name: String,
    /// Size of each dimension.
    pub shape: Vec<usize>,
    /// `[shape]` numbers.
    pub data: TensorData,
}

/// Which numbers an input takes. Floats must be finite besides.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Numbers {
    Any,
    /// From the first to the second.
    Within([f64; 2]),
    /// Indices of the rows of the tensor itself.
    OwnRows,
}

/// A tensor that a network takes or gives.
#[derive(Clone, Debug, PartialEq)]
pub struct TensorSpec {
    /// Name in the network.
    pub name: String,
    /// What its numbers are.
    pub kind: TensorKind,
    /// Size of each dimension; -1 where it is free.
    pub shape: Vec<i64>,
    /// For each dimension the name that the file gives it; empty where it has none. Dimensions of
    /// one name have one size.
    pub(super) symbols: Vec<String>,
    /// For each dimension the sizes that it may have; empty: 1 to `most`.
    pub(super) sizes: Vec<Vec<usize>>,
    /// For each dimension the largest size; [`FREE_MAX`] where there is none.
    pub(super) most: Vec<usize>,
    pub(super) numbers: Numbers,
}

/// The tensors of a network.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NetworkTensors {
    /// What it takes; all of them are needed.
    pub inputs: Vec<TensorSpec>,
    /// What it gives.
    pub outputs: Vec<TensorSpec>,
}

impl TensorSpec {
    /// Refuses a tensor with a size or a number that this one may not have.
    fn check(&self, given: &Tensor) -> Result<()> {
        let what = format!("input {:?}", self.name);
        if given.data.kind() != self.kind {
            let (found, wanted) = (given.data.kind(), self.kind);
            return Err(Error::invalid(format!("{what} is of {found:?}; it must be {wanted:?}")));
        }
        let (shape, rank) = (&given.shape, self.shape.len());
        if shape.len() != rank {
            let why = format!("{what} has the shape {shape:?}; it must have {rank} dimensions");
            return Err(Error::invalid(why));
        }
        for (axis, &size) in shape.iter().enumerate() {
            let most = self.most.get(axis).copied().unwrap_or(FREE_MAX);
            let (fits, must) = match self.sizes.get(axis).map_or(&[][..], |sizes| sizes) {
                [] => ((1..=most).contains(&size), format!("1 to {most}")),
                [only] => (size == *only, only.to_string()),
                sizes => (sizes.contains(&size), format!("one of {sizes:?}")),
            };
            if !fits {
                let why = format!("{what}: dimension {axis} has {size}; it must have {must}");
                return Err(Error::invalid(why));
            }
        }
        let (count, wanted) = (given.data.len(), shape.iter().product::<usize>());
        if count != wanted {
            let why = format!("{what} has {count} numbers; the shape {shape:?} has {wanted}");
            return Err(Error::invalid(why));
        }
        self.check_numbers(&what, given)
    }

    fn check_numbers(&self, what: &str, given: &Tensor) -> Result<()> {
        let [least, most] = match self.numbers {
            Numbers::Any => [f64::MIN, f64::MAX],
            Numbers::Within(range) => range,
            Numbers::OwnRows => [0.0, given.shape.first().map_or(0.0, |rows| *rows as f64 - 1.0)],
        };
        // NaN is in no range.
        let wrong = |value: &f64| !(least..=most).contains(value);
        let found = match &given.data {
            TensorData::F32(data) => data.iter().map(|v| f64::from(*v)).find(wrong),
            TensorData::I64(data) => data.iter().map(|v| *v as f64).find(wrong),
            TensorData::U8(_) => None,
        };
        match found {
            None => Ok(()),
            Some(value) if !value.is_finite() => {
                Err(Error::invalid(format!("{what} holds {value}; numbers must be finite")))
            }
            Some(value) => {
                let must = format!("numbers must be {least} to {most}");
                Err(Error::invalid(format!("{what} holds {value}; {must}")))
            }
        }
    }
}

impl NetworkTensors {
    /// Refuses inputs that are not those of the network, each once.
    pub(super) fn check(&self, given: &[Tensor]) -> Result<()> {
        let names = || self.inputs.iter().map(|input| &*input.name).collect::<Vec<_>>().join(", ");
        for (i, tensor) in given.iter().enumerate() {
            let name = short(&tensor.name);
            if given[..i].iter().any(|before| before.name == tensor.name) {
                return Err(Error::invalid(format!("input {name:?} is given twice")));
            }
            let Some(spec) = self.inputs.iter().find(|input| input.name == tensor.name) else {
                let must = format!("the network takes {}", names());
                return Err(Error::invalid(format!("input {name:?} is unknown; {must}")));
            };
            spec.check(tensor)?;
        }
        let lacks = |spec: &&TensorSpec| given.iter().all(|tensor| tensor.name != spec.name);
        if let Some(spec) = self.inputs.iter().find(lacks) {
            return Err(Error::invalid(format!("input {:?} is missing", spec.name)));
        }
        self.check_symbols(given)
    }

    /// Refuses dimensions of one name with two sizes.
    fn check_symbols(&self, given: &[Tensor]) -> Result<()> {
        let mut known: Vec<(&str, usize, &str)> = Vec::new();
        for tensor in given {
            let Some(spec) = self.inputs.iter().find(|input| input.name == tensor.name) else {
                continue;
            };
            let named = spec.symbols.iter().zip(&tensor.shape).filter(|(name, _)| !name.is_empty());
            for (symbol, &size) in named {
                match known.iter().find(|(name, ..)| name == symbol) {
                    None => known.push((symbol, size, &spec.name)),
                    Some((_, other, of)) if *other != size => {
                        return Err(Error::invalid(format!(
                            "input {:?} has {size} {symbol}, and input {of:?} has {other}",
                            spec.name
                        )));
                    }
                    Some(_) => {}
                }
            }
        }
        Ok(())
    }

    /// The outputs of these names, or all where there is none.
    pub(super) fn chosen(&self, only: &[String]) -> Result<Vec<&TensorSpec>> {
        if only.is_empty() {
            return Ok(self.outputs.iter().collect());
        }
        let chosen = |(i, name): (usize, &String)| {
            let name = name.as_str();
            if only[..i].iter().any(|before| before == name) {
                return Err(Error::invalid(format!("output {:?} is asked twice", short(name))));
            }
            self.outputs.iter().find(|output| output.name == name).ok_or_else(|| {
                let all: Vec<&str> = self.outputs.iter().map(|output| &*output.name).collect();
                let must = format!("the network gives {}", all.join(", "));
                Error::invalid(format!("output {:?} is unknown; {must}", short(name)))
            })
        };
        only.iter().enumerate().map(chosen).collect()
    }
}

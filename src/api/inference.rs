//! What the Open Inference Protocol, version 2, calls tensors: the same over HTTP and gRPC.

use crate::{
    error::{Error, Result, short},
    models::{TensorData, TensorKind},
};

/// Name of the server.
pub(super) const SERVER: &str = "segsplat";
/// Extensions of the protocol: tensors as bytes behind the JSON.
pub(super) const EXTENSIONS: [&str; 1] = ["binary_tensor_data"];
/// What the networks are.
pub(super) const PLATFORM: &str = "onnx_onnxv1";

/// The protocol's name of a kind.
pub(super) fn datatype(kind: TensorKind) -> &'static str {
    match kind {
        TensorKind::F32 => "FP32",
        TensorKind::I64 => "INT64",
        TensorKind::U8 => "UINT8",
    }
}

/// The kind of the protocol's name. `what` names the tensor.
pub(super) fn kind_of(what: &str, named: &str) -> Result<TensorKind> {
    let kinds = [TensorKind::F32, TensorKind::I64, TensorKind::U8];
    kinds.into_iter().find(|kind| datatype(*kind) == named).ok_or_else(|| {
        let must = "the networks take FP32 and INT64";
        Error::invalid(format!("{what} has the datatype {:?}; {must}", short(named)))
    })
}

/// Little-endian bytes as numbers.
pub(super) fn of_bytes(what: &str, kind: TensorKind, bytes: &[u8]) -> Result<TensorData> {
    let (data, rest) = match kind {
        TensorKind::F32 => {
            let (numbers, rest) = bytes.as_chunks();
            (TensorData::F32(numbers.iter().map(|n| f32::from_le_bytes(*n)).collect()), rest)
        }
        TensorKind::I64 => {
            let (numbers, rest) = bytes.as_chunks();
            (TensorData::I64(numbers.iter().map(|n| i64::from_le_bytes(*n)).collect()), rest)
        }
        TensorKind::U8 => (TensorData::U8(bytes.to_vec()), &[][..]),
    };
    if rest.is_empty() {
        return Ok(data);
    }
    let (bytes, kind) = (bytes.len(), datatype(kind));
    Err(Error::invalid(format!("{what} has {bytes} bytes, which are no numbers of {kind}")))
}

/// Numbers as little-endian bytes.
pub(super) fn to_bytes(data: &TensorData) -> Vec<u8> {
    match data {
        TensorData::F32(data) => data.iter().flat_map(|v| v.to_le_bytes()).collect(),
        TensorData::I64(data) => data.iter().flat_map(|v| v.to_le_bytes()).collect(),
        TensorData::U8(data) => data.clone(),
    }
}

/// The sizes of a shape. `what` names the tensor.
pub(super) fn shape_of(what: &str, shape: &[i64]) -> Result<Vec<usize>> {
    let size = |size: &i64| {
        usize::try_from(*size)
            .map_err(|_| Error::invalid(format!("{what} has a dimension of {size}")))
    };
    shape.iter().map(size).collect()
}

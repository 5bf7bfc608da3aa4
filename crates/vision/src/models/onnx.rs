//! What an ONNX file says of itself, read without its weights: opsets, files of external data, and
//! tensors that GPUs do not take.
//!
//! The reader walks the protobuf's fields and skips over the numbers, so that a file of 2 GiB takes
//! a few kilobytes of memory. Field numbers are those of `onnx.proto`.

use std::{
    collections::{BTreeMap, BTreeSet},
    io::{BufReader, Error, ErrorKind, Read, Result},
    path::Path,
};

/// Graphs inside nodes of graphs: more than any network has.
const DEPTH_MAX: u32 = 32;
/// Longest name that is read, bytes.
const NAME_BYTES_MAX: u64 = 4_096;
/// `TensorProto.DataType` of 64-bit floats.
const DOUBLE: u64 = 11;

/// Opsets, external files and 64-bit tensors of a network.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct OnnxHeader {
    /// Version of the operators of each domain; the empty name is ONNX's own.
    pub(super) opsets: BTreeMap<String, u64>,
    /// Files, relative to the network's own, that hold weights.
    pub(super) external: BTreeSet<String>,
    /// Constants of 64-bit floats. WebGPU has none, and a network with one does not open there.
    pub(super) doubles: usize,
}

impl OnnxHeader {
    /// Reads a file.
    ///
    /// # Errors
    /// What reading says; `InvalidData` where it is no ONNX file.
    pub(super) fn read(path: &Path) -> Result<Self> {
        let file = fs_err::File::open(path)?;
        let end = file.metadata()?.len();
        let mut header = Self::default();
        let mut reader = Fields { file: BufReader::new(file), at: 0 };
        reader.message(Message::Model, end, &mut header, 0)?;
        if header.opsets.is_empty() {
            return Err(invalid("it names no opset"));
        }
        Ok(header)
    }

    /// Version of ONNX's own operators.
    pub(super) fn opset(&self) -> Option<u64> {
        self.opsets.get("").or_else(|| self.opsets.get("ai.onnx")).copied()
    }
}

/// A message that is looked into.
#[derive(Clone, Copy)]
enum Message {
    Model,
    Opset,
    Graph,
    Node,
    Attribute,
    Tensor,
    SparseTensor,
}

impl Message {
    /// The message in a field of this one, where it matters.
    fn inner(self, field: u64) -> Option<Self> {
        match (self, field) {
            (Self::Model, 7) | (Self::Attribute, 6 | 11) => Some(Self::Graph),
            (Self::Model, 8) => Some(Self::Opset),
            (Self::Graph, 1) => Some(Self::Node),
            (Self::Graph, 5) | (Self::Attribute, 5 | 10) | (Self::SparseTensor, 1 | 2) => {
                Some(Self::Tensor)
            }
            (Self::Graph, 15) | (Self::Attribute, 22 | 23) => Some(Self::SparseTensor),
            (Self::Node, 5) => Some(Self::Attribute),
            _ => None,
        }
    }
}

struct Fields {
    file: BufReader<fs_err::File>,
    at: u64,
}

impl Fields {
    fn message(&mut self, of: Message, end: u64, found: &mut OnnxHeader, depth: u32) -> Result<()> {
        if depth > DEPTH_MAX {
            return Err(invalid("its graphs lie too deep in one another"));
        }
        let (mut domain, mut version) = (String::new(), 0);
        while self.at < end {
            let tag = self.varint()?;
            let (field, length) = match tag & 7 {
                0 => {
                    let value = self.varint()?;
                    match (of, tag >> 3) {
                        (Message::Opset, 2) => version = value,
                        (Message::Tensor, 2) if value == DOUBLE => found.doubles += 1,
                        _ => {}
                    }
                    continue;
                }
                1 => (0, 8),
                2 => (tag >> 3, self.varint()?),
                5 => (0, 4),
                _ => return Err(invalid("it is no protobuf")),
            };
            let to = self.at.checked_add(length).filter(|to| *to <= end);
            let to = to.ok_or_else(|| invalid("a field ends behind its message"))?;
            match (of, field) {
                (Message::Opset, 1) => domain = self.text(length)?,
                (Message::Tensor, 13) => {
                    let [key, value] = self.entry(to)?;
                    if key == "location" {
                        found.external.insert(value);
                    }
                }
                _ => match of.inner(field) {
                    Some(inner) => self.message(inner, to, found, depth + 1)?,
                    None => self.skip(length)?,
                },
            }
        }
        if self.at != end {
            return Err(invalid("a field ends behind its message"));
        }
        if matches!(of, Message::Opset) {
            found.opsets.insert(domain, version);
        }
        Ok(())
    }

    /// A key with its value.
    fn entry(&mut self, end: u64) -> Result<[String; 2]> {
        let mut pair = [String::new(), String::new()];
        while self.at < end {
            let (tag, length) = (self.varint()?, self.varint()?);
            if self.at.checked_add(length).is_none_or(|to| to > end) {
                return Err(invalid("a field ends behind its message"));
            }
            match tag {
                0x0a => pair[0] = self.text(length)?,
                0x12 => pair[1] = self.text(length)?,
                _ => return Err(invalid("an entry of external data is malformed")),
            }
        }
        Ok(pair)
    }

    fn varint(&mut self) -> Result<u64> {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let mut byte = [0];
            self.file.read_exact(&mut byte)?;
            self.at += 1;
            value |= u64::from(byte[0] & 0x7f) << shift;
            if byte[0] & 0x80 == 0 {
                return Ok(value);
            }
        }
        Err(invalid("a number has too many bytes"))
    }

    fn text(&mut self, length: u64) -> Result<String> {
        if length > NAME_BYTES_MAX {
            return Err(invalid("a name is too long"));
        }
        let mut bytes = Vec::new();
        self.file.by_ref().take(length).read_to_end(&mut bytes)?;
        self.at += length;
        String::from_utf8(bytes).map_err(|_| invalid("a name is no UTF-8"))
    }

    fn skip(&mut self, length: u64) -> Result<()> {
        self.at += length;
        let ahead = i64::try_from(length).map_err(|_| invalid("a field is too long"))?;
        self.file.seek_relative(ahead)
    }
}

fn invalid(why: &str) -> Error {
    Error::new(ErrorKind::InvalidData, why)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(bytes: &[u8]) -> Result<OnnxHeader> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("x.onnx");
        std::fs::write(&path, bytes).unwrap();
        OnnxHeader::read(&path)
    }

    #[test]
    fn opsets_and_external_files_are_found_between_other_fields() {
        // ir_version 8; graph { initializer { dims 2, data_type 11, raw_data 3 bytes,
        // external_data { location: "w.data" } } }; opset { domain "a", version 300 };
        // opset { version 17 }.
        let entry = b"\x0a\x08location\x12\x06w.data";
        let mut tensor = b"\x08\x02\x10\x0b\x4a\x03abc\x6a".to_vec();
        tensor.push(entry.len() as u8);
        tensor.extend(entry);
        let mut graph = vec![0x2a, tensor.len() as u8];
        graph.extend(tensor);
        let mut model = b"\x08\x08\x3a".to_vec();
        model.push(graph.len() as u8);
        model.extend(graph);
        model.extend(b"\x42\x06\x0a\x01a\x10\xac\x02\x42\x02\x10\x11");
        let found = read(&model).unwrap();
        assert_eq!(found.opsets, [("a".to_owned(), 300), (String::new(), 17)].into());
        assert_eq!(found.external, ["w.data".to_owned()].into());
        assert_eq!(found.doubles, 1);
        for cut in 0..model.len() - 12 {
            assert!(read(&model[..cut]).is_err(), "the first {cut} bytes");
        }
        // A field that claims more than there is takes no memory.
        assert!(read(b"\x3a\xff\xff\xff\xff\xff\xff\xff\xff\x7f").is_err(), "a graph of 2^63");
        assert!(read(b"\x42\xff\xff\xff\xff\x07\x0a\xff\xff\xff\xff\x06").is_err(), "a long name");
    }

    #[test]
    fn no_network_of_the_embedded_bundle_has_64_bit_floats() {
        let of = |entry: std::io::Result<std::fs::DirEntry>| entry.unwrap().path();
        let files = std::fs::read_dir(segsplat_testing::root().join("models/embedded")).unwrap();
        let networks: Vec<_> =
            files.map(of).filter(|p| p.extension() == Some("onnx".as_ref())).collect();
        assert!(networks.len() > 8, "{networks:?}");
        for path in networks {
            let found = OnnxHeader::read(&path).unwrap();
            assert_eq!(found.doubles, 0, "{}: WebGPU does not open it", path.display());
        }
    }
}

//! Archives that are cut, lie, climb or never end: each is refused by name.

use std::{collections::HashSet, io::Cursor};

use segsplat_core::{
    error::ErrorCode,
    limits::Limits,
    scene::{Upload, UploadFile},
};
use segsplat_testing::captures::zipped;
use segsplat_vision::{
    photos,
    sample::{self, SampleOptions},
};

/// A capture of two photos, its cameras last.
fn capture() -> Vec<UploadFile> {
    let options = SampleOptions { photos: 2, width: 24, height: 18, seed: 5 };
    let posed = sample::photos(&options).unwrap();
    let mut files = sample::png_files(&posed).unwrap();
    let bytes = sample::transforms_json(&posed);
    files.push(UploadFile { name: "transforms.json".to_owned(), bytes });
    files
}

fn limits() -> Limits {
    Limits { archive_entries_max: 50, archive_unpacked_bytes_max: 1 << 20, ..Limits::default() }
}

fn read(archive: Vec<u8>) -> segsplat_core::error::Result<()> {
    photos::read(&Upload { archive: Some(archive), ..Upload::default() }, &limits()).map(drop)
}

/// Refuses all of them, 20 or more and each another one, in words of the archive.
fn refused(what: &str, good: Vec<u8>, cases: Vec<(Vec<u8>, &str)>) {
    read(good).unwrap();
    let files: HashSet<&[u8]> = cases.iter().map(|(file, _)| &file[..]).collect();
    assert!(files.len() == cases.len() && files.len() >= 20, "{what}: {} files", files.len());
    println!("{what}: {} damaged files", files.len());
    let codes = [ErrorCode::InvalidRequest, ErrorCode::PhotoUnreadable, ErrorCode::LimitExceeded];
    let fault = |(file, says): (Vec<u8>, &str)| match read(file) {
        Err(e)
            if codes.contains(&e.code())
                && e.message().contains(says)
                && e.message().starts_with("archive")
                && e.message().len() < 300 =>
        {
            None
        }
        read => Some(format!("{read:?} says not {says:?}")),
    };
    let faults: Vec<_> = cases.into_iter().enumerate().map(|(i, case)| (i, fault(case))).collect();
    let faults: Vec<_> = faults.into_iter().filter(|(_, fault)| fault.is_some()).collect();
    assert!(faults.is_empty(), "{what}: {faults:#?}");
}

fn patched(file: &[u8], at: usize, bytes: &[u8]) -> Vec<u8> {
    let mut file = file.to_vec();
    file[at..at + bytes.len()].copy_from_slice(bytes);
    file
}

/// Where these bytes are, from the end on.
fn last(file: &[u8], bytes: &[u8]) -> usize {
    file.windows(bytes.len()).rposition(|window| window == bytes).expect("they are in it")
}

/// A file of this name and these bytes beside the capture.
fn beside(name: &str, bytes: &[u8]) -> Vec<UploadFile> {
    let mut files = capture();
    files.insert(0, UploadFile { name: name.to_owned(), bytes: bytes.to_vec() });
    files
}

#[test]
fn damaged_zips_are_refused_by_name() {
    let good = zipped(&capture(), "");
    // Of the cameras: their record in the directory and their bytes; and the end record.
    let record = last(&good, b"PK\x01\x02");
    let end = last(&good, b"PK\x05\x06");
    let own = u32::from_le_bytes(good[record + 42..record + 46].try_into().unwrap()) as usize;
    let data = own + 30 + "transforms.json".len();
    let with = |at: usize, bytes: &[u8]| patched(&good, at, bytes);
    let named = |name: &str| zipped(&beside(name, b"x"), "");
    // The zip writer writes no name twice.
    let renamed = |from: &str, to: &[u8]| {
        let mut zip = zipped(&beside(from, b"x"), "");
        while let Some(at) = zip.windows(from.len()).position(|w| w == from.as_bytes()) {
            zip[at..at + to.len()].copy_from_slice(to);
        }
        zip
    };
    let mut link = zip::ZipWriter::new(Cursor::new(Vec::new()));
    link.add_symlink("a.png", "/etc/passwd", zip::write::SimpleFileOptions::default()).unwrap();
    let many: Vec<_> =
        (0..51).map(|i| UploadFile { name: format!("{i}.txt"), bytes: Vec::new() }).collect();
    let cases = vec![
        (good[..2].to_vec(), "damaged"),
        (good[..30].to_vec(), "damaged"),
        (good[..good.len() / 2].to_vec(), "damaged"),
        (good[..record].to_vec(), "damaged"),
        (good[..end].to_vec(), "damaged"),
        (good[..good.len() - 1].to_vec(), "damaged"),
        (with(end + 10, &u16::MAX.to_le_bytes()), "damaged"),
        (with(end + 10, &1000_u16.to_le_bytes()), "damaged"),
        (with(end + 16, &(u32::MAX - 1).to_le_bytes()), "damaged"),
        (with(record, b"PK\x01\x03"), "damaged"),
        (with(record + 28, &u16::MAX.to_le_bytes()), "damaged"),
        (with(record + 42, &(u32::MAX - 1).to_le_bytes()), "\"transforms.json\" is damaged"),
        (with(record + 42, &7_u32.to_le_bytes()), "\"transforms.json\" is damaged"),
        (with(record + 8, &1_u16.to_le_bytes()), "\"transforms.json\" is encrypted"),
        (with(record + 10, &99_u16.to_le_bytes()), "\"transforms.json\" is damaged"),
        (with(record + 20, &3_u32.to_le_bytes()), "\"transforms.json\" is damaged"),
        (with(record + 24, &10_u32.to_le_bytes()), "\"transforms.json\" is damaged"),
        (with(record + 24, &(8_u32 << 20).to_le_bytes()), "is over 1048576"),
        (with(data, &[0xff; 8]), "\"transforms.json\" is damaged"),
        (zipped(&beside("bomb.png", &vec![0; 3 << 20]), ""), "is over 1048576"),
        (zipped(&many, ""), "51 is over 50"),
        (named("../evil.png"), "relative path"),
        (named("a/../../evil.png"), "relative path"),
        (named("/etc/evil.png"), "relative path"),
        (named("C:\\evil.png"), "relative path"),
        (named(&"a".repeat(5_000)), "bytes of the name"),
        (renamed("images/000x.png", b"images/0000.png"), "two entries"),
        (link.finish().unwrap().into_inner(), "link"),
    ];
    refused("zip", good.clone(), cases);
}

/// A header of a tar with right checksum: name, kind and what is in the field of its size.
fn header(name: &[u8], kind: u8, size: &[u8; 12]) -> Vec<u8> {
    let mut header = tar::Header::new_ustar();
    let field = header.as_mut_bytes();
    field[..name.len()].copy_from_slice(name);
    field[156] = kind;
    field[124..136].copy_from_slice(size);
    header.set_cksum();
    header.as_bytes().to_vec()
}

fn octal(size: u64) -> [u8; 12] {
    format!("{size:011o}\0").into_bytes().try_into().unwrap()
}

fn tarred(files: &[UploadFile]) -> Vec<u8> {
    let mut tar = Vec::new();
    for file in files {
        tar.extend(header(file.name.as_bytes(), b'0', &octal(file.bytes.len() as u64)));
        tar.extend(&file.bytes);
        tar.resize(tar.len().next_multiple_of(512), 0);
    }
    tar.resize(tar.len() + 1024, 0);
    tar
}

#[test]
fn damaged_tars_are_refused_by_name() {
    let good = tarred(&capture());
    let first = |name: &str, kind: u8, size: &[u8; 12], body: &[u8]| {
        let mut block = body.to_vec();
        block.resize(block.len().next_multiple_of(512), 0);
        [&header(name.as_bytes(), kind, size)[..], &block, &good].concat()
    };
    let entry = |name: &str| first(name, b'0', &octal(1), b"x");
    let kind = |kind: u8| first("a.png", kind, &octal(0), b"");
    let pax = |line: &str| first("p", b'x', &octal(line.len() as u64), line.as_bytes());
    // Where the cameras' header begins.
    let cameras = last(&good, b"transforms.json");
    let many: Vec<_> =
        (0..51).map(|i| UploadFile { name: format!("{i}.txt"), bytes: Vec::new() }).collect();
    let big = |first: u8| {
        let mut size = [0xff; 12];
        size[0] = first;
        size
    };
    let long = "a".repeat(5_000);
    let cases = vec![
        (good[..262].to_vec(), "damaged"),
        (good[..511].to_vec(), "damaged"),
        (good[..520].to_vec(), "is cut short"),
        (good[..cameras + 100].to_vec(), "damaged"),
        (good[..cameras + 512].to_vec(), "is cut short"),
        (good[..cameras + 600].to_vec(), "is cut short"),
        (patched(&good, 0, b"X"), "damaged"),
        (patched(&good, 148, b"9999999\0"), "damaged"),
        (patched(&good, cameras + 148, b"\xff\xff\xff"), "damaged"),
        (first("a.png", b'0', b"hello world\0", b""), "damaged"),
        (first("a.png", b'0', b"-0000000001\0", b""), "damaged"),
        (first("a.png", b'0', &octal((8 << 30) - 1), b""), "is over 1048576"),
        (first("a.png", b'0', &octal(900 << 10), b""), "is cut short"),
        (first("a.png", b'0', &big(0x80), b""), "damaged"),
        (first("a.png", b'0', &big(0xff), b""), "damaged"),
        (first("a.png", b'0', &octal(3 << 20), &vec![0; 3 << 20]), "is over 1048576"),
        (kind(b'1'), "link"),
        (kind(b'2'), "link"),
        (kind(b'3'), "link"),
        (kind(b'4'), "link"),
        (kind(b'6'), "link"),
        (kind(b'S'), "damaged"),
        (entry("../evil.png"), "relative path"),
        (entry("a/../../evil.png"), "relative path"),
        (entry("/etc/evil.png"), "relative path"),
        (entry("C:\\evil.png"), "relative path"),
        (entry(""), "relative path"),
        (entry("images/0000.png"), "two entries"),
        ([header(b"\xff\xfe", b'0', &octal(0)), good.clone()].concat(), "not UTF-8"),
        (first("l", b'L', &octal(long.len() as u64), long.as_bytes()), "bytes of the name"),
        (first("l", b'L', &octal((8 << 30) - 1), b"x"), "damaged"),
        (pax("20 path=../evil.png\n"), "relative path"),
        (pax("20 size=99999999999\n"), "is over 1048576"),
        (tarred(&many), "more than 50"),
    ];
    refused("tar", good.clone(), cases);
}

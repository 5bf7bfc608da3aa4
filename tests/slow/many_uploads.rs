//! Uploads of hundreds of photos: the memory of the process has a bound that does not grow with
//! what is sent.

use std::time::Instant;

use segsplat::{
    sample::{self, SampleOptions},
    scene::Upload,
};

use crate::common::process::{self, Start, can_serve, long};

/// Photos of the short form and of the long one, and bytes of each.
const PHOTOS: [usize; 2] = [40, 300];
const PHOTO_BYTES: usize = 4 << 20;
/// What may come to the memory of the idle process: what stays of an upload, a few parts on their
/// way to the store, two photos at once, and what the jobs of small photos take.
const MEMORY_MAX: u64 = 128 << 20;

/// A JPEG of so many bytes: comments, which no decoder keeps, make it as long as a photo of 12
/// megapixels.
fn padded(jpeg: &[u8], bytes: usize) -> Vec<u8> {
    let (start, rest) = jpeg.split_at(2);
    let mut padded = start.to_vec();
    while padded.len() + rest.len() < bytes {
        padded.extend([0xff, 0xfe, 0xff, 0xff]);
        padded.extend((0..0xfffd_u32).map(|i| (i % 251) as u8));
    }
    padded.extend(rest);
    padded
}

/// Photos of the sample room as JPEGs of the bytes of large photos.
fn upload(photos: usize) -> Upload {
    let options = SampleOptions { photos, width: 160, height: 120, seed: 9 };
    let mut upload = sample::upload(&options).expect("in range");
    for photo in &mut upload.photos {
        let picture = image::load_from_memory(&photo.bytes).unwrap();
        let mut jpeg = std::io::Cursor::new(Vec::new());
        picture.write_to(&mut jpeg, image::ImageFormat::Jpeg).unwrap();
        photo.bytes = padded(&jpeg.into_inner(), PHOTO_BYTES);
    }
    upload
}

#[tokio::test(flavor = "multi_thread")]
async fn memory_does_not_grow_with_the_bytes_of_an_upload() {
    if !can_serve() {
        return;
    }
    let data = tempfile::tempdir().unwrap();
    let server = Start::on(data.path()).arg("--refine").arg("off").start();
    let client = crate::common::client();
    // What the first scene takes is no part of it.
    let small = sample::upload(&SampleOptions { photos: 8, width: 160, height: 120, seed: 9 });
    process::create(&client, &server.url, &small.unwrap(), 60_000, None).await.unwrap();
    let sent = upload(PHOTOS[usize::from(long())]);
    let (idle, begun) = (server.peak(), Instant::now());
    let (status, said) = process::create(&client, &server.url, &sent, 600_000, None).await.unwrap();
    assert_eq!((status, said["state"].as_str()), (201, Some("done")), "{said}");
    let more = server.peak() - idle;
    println!(
        "{} photos, {} MiB: {:.1} s, memory {} MiB over {} MiB",
        sent.photos.len(),
        sent.size_bytes() >> 20,
        begun.elapsed().as_secs_f64(),
        more >> 20,
        idle >> 20
    );
    assert!(more < MEMORY_MAX, "{} MiB came", more >> 20);
}

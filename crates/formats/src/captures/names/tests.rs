//! Names of every system find their photos.

use super::{decoded, matched};

/// Names that cameras give, names of the photos, and the photo of each camera.
type Case<'a> = (&'a [&'a str], &'a [&'a str], &'a [usize]);

#[test]
fn a_camera_finds_the_photo_of_the_longest_common_tail() {
    const NONE: usize = usize::MAX;
    let cases: &[Case<'_>] = &[
        (&["C:\\Users\\x\\images\\0.jpg", "D:1.jpg"], &["images/0.jpg", "images/1.jpg"], &[0, 1]),
        (&["\\\\nas\\share\\images\\0.jpg", "\\\\?\\C:\\a\\1.jpg"], &["0.jpg", "1.jpg"], &[0, 1]),
        (&["..\\images\\0.jpg", "./..\\x/1.jpg"], &["images/0.jpg", "images/1.jpg"], &[0, 1]),
        (&["file:///C:/a/0.jpg", "https://h/1.jpg?sig=a/b"], &["a/0.jpg", "1.jpg"], &[0, 1]),
        (&["s3://bucket/x/../y/0.jpg", "/home/1.jpg"], &["x/0.jpg", "y/0.jpg", "1.jpg"], &[1, 2]),
        (
            &["/data/rig/cam0/rgb/0.jpg", "/data/rig/cam1/rgb/0.jpg"],
            &["cam1/rgb/0.jpg", "cam0/rgb/0.jpg"],
            &[1, 0],
        ),
        (&["../rig/cam0\\0.jpg", "cam1/0.jpg"], &["s/cam0/0.jpg", "s/cam1/0.jpg"], &[0, 1]),
        (&["IMG_0.JPG", "Images/img_1.jpg"], &["images/IMG_0.jpg", "images/IMG_1.JPG"], &[0, 1]),
        (&["Ü.JPG", "e\u{301}.jpg"], &["images/u\u{308}.jpg", "images/\u{e9}.jpg"], &[0, 1]),
        (&["images/IMG (1).jpg", "a b.jpg"], &["images%2FIMG%20%281%29.jpg", "a%20b.JPG"], &[0, 1]),
        (&["images%2F0.jpg", "K%C3%BCche.jpg"], &["images/0.jpg", "Küche.jpg"], &[0, 1]),
        (
            &["Küche 0.jpg", "b/1.jpg"],
            &["=?utf-8?B?S8O8Y2hlIDAuanBn?=", "=?UTF-8?Q?b/1=2Ejpg?="],
            &[0, 1],
        ),
        (&["IMG_1.HEIC", "a.v1"], &["IMG_1.jpg", "a.v1.png"], &[0, 1]),
        // A strict level comes first, and a whole path before a longer one.
        (&["a.jpg", "A.jpg"], &["A.jpg", "a.jpg"], &[1, 0]),
        (&["a%20b.jpg", "a b.jpg"], &["a b.jpg", "a%20b.jpg"], &[1, 0]),
        (&["0.jpg", "sub/0.jpg"], &["sub/0.jpg", "0.jpg"], &[1, 0]),
        // Who has a photo of its own leaves the other to others.
        (&["0.jpg", "a/0.jpg"], &["a/0.jpg", "b/0.jpg"], &[1, 0]),
        // In a rig a folder that a camera names stands for no other.
        (
            &["cam0/0.jpg", "cam1/1.jpg", "cam0/1.jpg"],
            &["cam1/0.jpg", "cam1/1.jpg"],
            &[NONE, 1, NONE],
        ),
        (&["0001.jpg"], &["0001.jpg.png"], &[NONE]),
        (&["x.jpg", ""], &["y.jpg"], &[NONE, NONE]),
    ];
    for (wanted, sent, want) in cases {
        let got = matched(wanted, sent).unwrap_or_else(|error| panic!("{wanted:?}: {error}"));
        let got: Vec<usize> = got.into_iter().map(|file| file.unwrap_or(NONE)).collect();
        assert_eq!(got, *want, "{wanted:?} {sent:?}");
    }
}

#[test]
fn what_could_mean_two_is_refused_by_both_names() {
    let cases: [(&[&str], &[&str], [&str; 2]); 5] = [
        (&["0.jpg"], &["a/0.jpg", "b/0.jpg"], ["\"a/0.jpg\"", "\"b/0.jpg\""]),
        (&["/x/img.jpg"], &["a/IMG.jpg", "b/Img.jpg"], ["\"a/IMG.jpg\"", "\"b/Img.jpg\""]),
        (&["a.HEIC"], &["a.jpg", "a.png"], ["\"a.jpg\"", "\"a.png\""]),
        (&["x/a.jpg", "y/a.jpg"], &["a.jpg"], ["\"x/a.jpg\"", "\"y/a.jpg\""]),
        (&["a.jpg", "./a.jpg"], &["a.jpg"], ["\"a.jpg\"", "\"./a.jpg\""]),
    ];
    for (wanted, sent, words) in cases {
        let error = matched(wanted, sent).expect_err("two");
        assert!(words.iter().all(|word| error.message().contains(word)), "{error}");
    }
}

#[test]
fn names_are_decoded_only_where_they_are_encoded() {
    assert_eq!(decoded("a%2Fb%C3%A9.jpg").as_deref(), Some("a/bé.jpg"));
    assert_eq!(
        decoded("=?utf-8?B?w6k=?= =?iso-8859-1*de?q?=E9_x?=.jpg").as_deref(),
        Some("éé x.jpg")
    );
    for plain in
        ["100%.jpg", "a%zz.jpg", "%ff.jpg", "a=?b.jpg", "=?utf-7?B?AAAA?=", "=?utf-8?B?é?="]
    {
        assert_eq!(decoded(plain), None, "{plain}");
    }
}

/// Many cameras and photos of one name are paired, or refused, in a time that is linear in them.
#[test]
fn many_photos_of_one_name_take_no_long_time() {
    let name = |start: &str| (0..16_000).map(|i| format!("{start}{i}/0.jpg")).collect::<Vec<_>>();
    let (a, b) = (name("a"), name("b"));
    let refs = |all: &[String]| -> Vec<&'static str> {
        all.iter().map(|name| &*name.clone().leak()).collect()
    };
    let (a, b) = (refs(&a), refs(&b));
    assert_eq!(matched(&a, &a).unwrap(), (0..16_000).map(Some).collect::<Vec<_>>());
    assert!(matched(&a, &b).is_err());
}

//! Metashape's `cameras.xml` (File > Export > Export Cameras, "Agisoft XML").
//!
//! A `sensor` has a `resolution` and a `calibration`: f, cx and cy from the middle of the photo,
//! k1 to k4, p1, p2, b1, b2, in the formulas of Metashape's manual, "Camera models": p1 and p2
//! stand the other way round than OpenCV's, the focal lengths are f + b1 and f, b2 is a skew. A
//! `camera` with a `transform` was aligned: 16 numbers, camera to chunk, row by row, OpenCV axes.
//! The `transform` of its `component`, or of the chunk, brings it into the world: rotation,
//! translation and scale. Photos are called by labels, often without an extension.

use std::collections::{BTreeMap, BTreeSet};

use glam::{DMat3, DVec3};
use quick_xml::{Reader, events::Event};

use crate::{
    captures::layout::{
        Base, CameraEntry, Described, Folder, Layout, Lens, PoseAxes, Terms, cameras::Cameras,
        names, number_of, numbers, pinhole, pose, text,
    },
    error::{Error, Result},
};

pub(super) struct Metashape;

/// Bytes of a file in which its first element must be.
const HEAD_BYTES: usize = 4096;

/// An element of XML.
#[derive(Default)]
struct Element {
    name: String,
    attributes: BTreeMap<String, String>,
    text: String,
    children: Vec<Self>,
}

impl Element {
    fn child(&self, name: &str) -> Option<&Self> {
        self.children.iter().find(|child| child.name == name)
    }

    fn attribute(&self, name: &str) -> &str {
        self.attributes.get(name).map_or("", String::as_str)
    }

    /// All elements of this name in it, at any depth.
    fn all<'a>(&'a self, name: &str) -> Vec<&'a Self> {
        let (mut found, mut open) = (Vec::new(), vec![self]);
        while let Some(element) = open.pop() {
            for child in element.children.iter().rev() {
                open.push(child);
            }
            if element.name == name {
                found.push(element);
            }
        }
        found
    }

    /// The number in a child; `None` where it is absent.
    fn number(&self, name: &str, what: &str) -> Result<Option<f64>> {
        let Some(child) = self.child(name) else { return Ok(None) };
        let wrong = || Error::invalid(format!("{what}: {name} is not a number"));
        number_of(child.text.trim()).map(Some).ok_or_else(wrong)
    }
}

/// The elements of an XML text, `max` at most.
fn elements(text: &str, path: &str, max: usize) -> Result<Element> {
    let broken =
        |why: &dyn std::fmt::Display| Error::invalid(format!("{path}: not valid XML ({why})"));
    let mut reader = Reader::from_str(text);
    let (mut open, mut count) = (vec![Element::default()], 0);
    loop {
        let event = reader.read_event().map_err(|e| broken(&e))?;
        match event {
            Event::Start(ref start) | Event::Empty(ref start) => {
                count += 1;
                if count > max {
                    let what = format!("{path}: elements");
                    return Err(Error::limit(what, format!("more than {max}"), max));
                }
                let name = String::from_utf8_lossy(start.name().as_ref()).into_owned();
                let mut element = Element { name, ..Element::default() };
                for attribute in start.attributes() {
                    let attribute = attribute.map_err(|e| broken(&e))?;
                    let key = String::from_utf8_lossy(attribute.key.as_ref()).into_owned();
                    let value = String::from_utf8_lossy(&attribute.value).into_owned();
                    let value = quick_xml::escape::unescape(&value).map_err(|e| broken(&e))?;
                    element.attributes.insert(key, value.into_owned());
                }
                if matches!(event, Event::Start(_)) {
                    open.push(element);
                } else if let Some(parent) = open.last_mut() {
                    parent.children.push(element);
                }
            }
            Event::End(_) => {
                if let (Some(element), Some(parent)) = (open.pop(), open.last_mut()) {
                    parent.children.push(element);
                }
            }
            Event::Text(of) => {
                if let Some(element) = open.last_mut() {
                    element.text.push_str(&String::from_utf8_lossy(&of));
                }
            }
            Event::Eof => break,
            _ => {}
        }
    }
    let cut = || broken(&"it is cut short");
    if open.len() == 1 { open.pop().ok_or_else(cut) } else { Err(cut()) }
}

impl Layout for Metashape {
    fn name(&self) -> &'static str {
        "Metashape"
    }

    fn find(&self, folder: &Folder<'_>) -> Vec<String> {
        let xmls = folder.paths().filter(|path| path.to_lowercase().ends_with(".xml"));
        let is_chunk = |path: &&str| {
            let head = folder.head(path, HEAD_BYTES).unwrap_or_default();
            head.windows(6).any(|word| word == b"<chunk")
        };
        xmls.filter(is_chunk).map(str::to_owned).collect()
    }

    fn read(&self, folder: &Folder<'_>, at: &str) -> Result<Described> {
        let bytes = folder.read_cameras(at)?;
        let all = elements(&text(&bytes, at)?, at, folder.limits.json_values_max)?;
        let chunks = all.all("chunk");
        // Of several that with most aligned cameras.
        let aligned = |chunk: &&Element| {
            let cameras = chunk.all("camera");
            cameras.into_iter().filter(|camera| camera.child("transform").is_some()).count()
        };
        let chunk = chunks.into_iter().max_by_key(aligned);
        let chunk = chunk.ok_or_else(|| Error::invalid(format!("{at}: it has no chunk")))?;
        let mut unread = BTreeSet::new();
        let mut lenses = BTreeMap::new();
        for sensor in chunk.all("sensor") {
            lenses.insert(sensor.attribute("id"), lens(sensor, at, &mut unread));
        }
        let of_component: BTreeMap<&str, &Element> = (chunk.all("component").into_iter())
            .filter_map(|component| {
                Some((component.attribute("id"), component.child("transform")?))
            })
            .collect();
        let of_chunk = chunk.child("transform");
        let mut entries = Vec::new();
        for camera in chunk.all("camera") {
            let Some(own) = camera.child("transform") else { continue };
            let label = camera.attribute("label");
            let what = format!("{at}: camera {label:?}");
            let own = numbers(&own.text).filter(|own| own.len() == 16);
            let own =
                own.ok_or_else(|| Error::invalid(format!("{what}: transform must be 16 numbers")))?;
            let lens = lenses.get(camera.attribute("sensor_id"));
            let lens = lens
                .ok_or_else(|| Error::invalid(format!("{what} has a sensor that is not there")))?;
            let world = of_component.get(camera.attribute("component_id")).copied().or(of_chunk);
            let (turn, place, scale) = match world {
                Some(world) => similarity(world, at)?,
                None => (DMat3::IDENTITY, DVec3::ZERO, 1.0),
            };
            let rows = [0, 4, 8].map(|row| [own[row], own[row + 1], own[row + 2]]);
            let rotation = turn * DMat3::from_cols_array_2d(&rows).transpose();
            let centre = turn * DVec3::new(own[3], own[7], own[11]) * scale + place;
            let pose = pose(rotation, centre);
            let lens = lens.clone().map_err(Error::invalid)?;
            entries.push(CameraEntry::new(label.to_owned(), lens, PoseAxes::OpenCv, pose));
        }
        let cameras = Cameras { entries, unread, ..Cameras::default() };
        Ok(Described { root: names::folder(at).to_owned(), cameras })
    }
}

/// Rotation, translation and scale of a `transform`.
fn similarity(of: &Element, at: &str) -> Result<(DMat3, DVec3, f64)> {
    let list = |name: &str, count: usize| {
        let Some(child) = of.child(name) else { return Ok(None) };
        let numbers = numbers(&child.text).filter(|numbers| numbers.len() == count);
        let wrong = || Error::invalid(format!("{at}: {name} must be {count} numbers"));
        numbers.map(Some).ok_or_else(wrong)
    };
    let rotation = list("rotation", 9)?.map_or(DMat3::IDENTITY, |r| {
        DMat3::from_cols_array_2d(&[[r[0], r[3], r[6]], [r[1], r[4], r[7]], [r[2], r[5], r[8]]])
    });
    let place = list("translation", 3)?.map_or(DVec3::ZERO, |t| DVec3::new(t[0], t[1], t[2]));
    let scale = list("scale", 1)?.map_or(1.0, |scale| scale[0]);
    Ok((rotation, place, scale))
}

/// The lens of a sensor, or why it has none.
fn lens(
    sensor: &Element,
    at: &str,
    unread: &mut BTreeSet<String>,
) -> std::result::Result<Lens, String> {
    let what = format!("{at}: sensor {:?}", sensor.attribute("label"));
    let read = || -> Result<Lens> {
        let wrong = |why: &str| Error::invalid(format!("{what}{why}"));
        let calibrations = sensor.all("calibration");
        let is_adjusted = |one: &&&Element| one.attribute("class") == "adjusted";
        let calibration = calibrations.iter().find(is_adjusted).or(calibrations.last());
        let calibration = calibration.ok_or_else(|| wrong(" has no calibration"))?;
        let kind = match calibration.attribute("type") {
            "" => sensor.attribute("type"),
            kind => kind,
        };
        let base = match kind {
            "" | "frame" => Base::Tangent,
            "fisheye" | "equidistant_fisheye" => Base::Angle,
            other => return Err(wrong(&format!(" is of the type {other:?}, which is not read"))),
        };
        let size = calibration.child("resolution").or(sensor.child("resolution"));
        let side = |name: &str| {
            let side = size.and_then(|size| number_of(size.attribute(name)));
            side.ok_or_else(|| wrong(" has no resolution"))
        };
        let (width, height) = (side("width")?, side("height")?);
        let get = |name: &str| Ok::<_, Error>(calibration.number(name, &what)?.unwrap_or(0.0));
        let fy = calibration.number("f", &what)?.ok_or_else(|| wrong(" has no f"))?;
        let centre = [0.5 * width + get("cx")?, 0.5 * height + get("cy")?];
        let terms = Terms {
            base,
            k: [get("k1")?, get("k2")?, get("k3")?, get("k4")?, 0.0, 0.0],
            p: [get("p2")?, get("p1")?],
            ..Terms::default()
        };
        let focal = [fy + get("b1")?, fy, centre[0], centre[1]];
        Ok(Lens { terms: Some(terms), ..pinhole(focal, Some([width, height])) })
    };
    for name in ["b2", "p3", "p4"] {
        let is_there = |of: &&Element| of.text.trim().parse() != Ok(0.0_f64);
        if sensor.all(name).iter().any(is_there) {
            unread.insert(name.to_owned());
        }
    }
    read().map_err(|error| error.message().to_owned())
}

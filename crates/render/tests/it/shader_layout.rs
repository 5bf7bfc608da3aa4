//! The shaders as the host believes them to be: valid, of the same layout, with the same numbers,
//! each with a CPU stage of the same name.

use std::{collections::BTreeMap, mem::offset_of};

use naga::{Expression, Literal, Module, TypeInner};
use segsplat_render::{
    constants,
    gpu::internals::{
        self, BlockRow, FootprintRow, GaussianRow, PlanRow, SHADERS, Shader, SourceRow,
        TrainingRow, ViewRow,
    },
};

use segsplat_testing::root;

fn parse(shader: &Shader) -> Module {
    naga::front::wgsl::parse_str(shader.source)
        .unwrap_or_else(|error| panic!("{}: {}", shader.stem, error.emit_to_string(shader.source)))
}

#[test]
fn every_shader_is_valid() {
    for shader in &SHADERS {
        let module = parse(shader);
        let mut validator = naga::valid::Validator::new(
            naga::valid::ValidationFlags::all(),
            // No capability beyond WebGPU's floor: no subgroups, no f16, no 64-bit integers.
            naga::valid::Capabilities::empty(),
        );
        validator.validate(&module).unwrap_or_else(|error| {
            panic!("{}: {}", shader.stem, error.emit_to_string(shader.source))
        });
    }
}

#[test]
fn workgroups_stay_under_the_portable_floor() {
    for shader in &SHADERS {
        let module = parse(shader);
        let info = naga::valid::Validator::new(
            naga::valid::ValidationFlags::all(),
            naga::valid::Capabilities::empty(),
        )
        .validate(&module)
        .unwrap_or_else(|error| panic!("{}: {error}", shader.stem));
        let mut layouter = naga::proc::Layouter::default();
        layouter.update(module.to_ctx()).expect("types have sizes");
        for (at, entry) in module.entry_points.iter().enumerate() {
            let what = format!("{}: {}", shader.stem, entry.name);
            let [x, y, z] = entry.workgroup_size;
            assert!(x * y * z <= 256, "{what} has {x} x {y} x {z} invocations");
            let used = info.get_entry_point(at);
            let globals = || module.global_variables.iter().filter(|(at, _)| !used[*at].is_empty());
            let bytes: u32 = globals()
                .filter(|(_, variable)| variable.space == naga::AddressSpace::WorkGroup)
                .map(|(_, variable)| layouter[variable.ty].size)
                .sum();
            assert!(bytes <= 16 << 10, "{what}: {bytes} bytes of workgroup storage");
            let storage = globals()
                .filter(|(_, v)| matches!(v.space, naga::AddressSpace::Storage { .. }))
                .count();
            assert!(storage <= 8, "{what}: {storage} storage buffers");
        }
    }
}

/// Offset of each member of the struct `name`, and the struct's size.
fn layout_of(module: &Module, name: &str) -> Option<(BTreeMap<String, u32>, u32)> {
    module.types.iter().find_map(|(_, ty)| match &ty.inner {
        TypeInner::Struct { members, span } if ty.name.as_deref() == Some(name) => {
            let offsets = members
                .iter()
                .map(|member| (member.name.clone().expect("members have names"), member.offset));
            Some((offsets.collect(), *span))
        }
        _ => None,
    })
}

macro_rules! layout {
    ($rust:ty, $wgsl:literal, [$($field:ident),* $(,)?]) => {{
        let offsets: BTreeMap<String, u32> = [
            $((stringify!($field).to_owned(), offset_of!($rust, $field) as u32)),*
        ]
        .into();
        ($wgsl, offsets, size_of::<$rust>() as u32)
    }};
}

#[test]
fn structs_lie_in_memory_as_the_shaders_say() {
    let layouts = [
        layout!(
            ViewRow,
            "View",
            [
                rotation_x,
                rotation_y,
                rotation_z,
                rotation_z_low,
                center,
                center_low,
                background,
                ray_end,
                focal,
                principal,
                slope_min,
                slope_max,
                near,
                width,
                height,
                tiles_x,
                tiles_y,
                row_start,
                row_end,
                gaussian_count,
                sh_count,
                antialiased,
                isect_capacity,
                zero,
                color_start,
                depth_start,
                alpha_start,
                blend_start,
                label_rows,
                table_start,
                weight_slots,
                slot_start,
                range_start,
                pair_start,
                levels,
                alpha_byte_start,
                mask_start,
                steps_start,
                backdrop_start,
                room_min,
                coverage_floor,
                own_focal,
                source_count,
                source_start,
                ray_first,
                ray_across,
                ray_down,
                sides,
                photos,
                photos_widen,
                block_count,
                detail,
                rest,
            ]
        ),
        layout!(BlockRow, "Block", [center, reach, half, error, parent, rest]),
        layout!(GaussianRow, "Gaussian", [mean, opacity, quat, scale, source]),
        layout!(
            FootprintRow,
            "Footprint",
            [mean, conic_shear, conic_x, conic_y, power_max, opacity, depth]
        ),
        layout!(SourceRow, "Source", [center, scale, axis, layer]),
        layout!(PlanRow, "Plan", [isects, needed, visible, farthest, rows]),
        layout!(
            TrainingRow,
            "Training",
            [
                means,
                quats,
                scales,
                opacities,
                sh,
                sh_rest,
                exposure,
                opacity_min,
                ssim_share,
                photo,
                photo_start,
                blames,
            ]
        ),
    ];
    for (name, offsets, size) in layouts {
        let mut seen = 0;
        for shader in &SHADERS {
            // Every shader holds every struct, whether it uses it or not.
            let (wgsl, span) = layout_of(&parse(shader), name)
                .unwrap_or_else(|| panic!("{}: no struct {name}", shader.stem));
            assert_eq!(wgsl, offsets, "{}: members of {name}", shader.stem);
            assert_eq!(span, size, "{}: size of {name}", shader.stem);
            seen += 1;
        }
        assert_eq!(seen, SHADERS.len(), "{name} was looked for");
    }
}

/// The numbers of the module-scope constant `name`, as f64.
fn constant(module: &Module, name: &str) -> Option<Vec<f64>> {
    let (_, constant) =
        module.constants.iter().find(|(_, constant)| constant.name.as_deref() == Some(name))?;
    Some(numbers(module, constant.init))
}

fn numbers(module: &Module, at: naga::Handle<Expression>) -> Vec<f64> {
    match &module.global_expressions[at] {
        Expression::Literal(Literal::F32(v)) => vec![f64::from(*v)],
        Expression::Literal(Literal::U32(v)) => vec![f64::from(*v)],
        Expression::Compose { components, .. } => {
            components.iter().flat_map(|&part| numbers(module, part)).collect()
        }
        other => panic!("a constant of the kind {other:?}"),
    }
}

#[test]
fn constants_are_those_of_the_host() {
    let narrow = |values: &[f32]| values.iter().map(|&v| f64::from(v)).collect::<Vec<_>>();
    let mut wanted: Vec<(&str, Vec<f64>)> = vec![
        ("TILE_SIZE", vec![f64::from(constants::TILE_SIZE)]),
        ("ATAN", narrow(&constants::ATAN)),
        ("SH_C2", narrow(&constants::SH_C2)),
        ("SH_C3", narrow(&constants::SH_C3)),
    ];
    wanted.extend(constants::SHARED.iter().map(|&(name, value)| (name, narrow(&[value]))));
    wanted.extend(internals::SHARED.iter().map(|&(name, value)| (name, vec![f64::from(value)])));
    for shader in &SHADERS {
        let module = parse(shader);
        for (name, value) in &wanted {
            let got = constant(&module, name)
                .unwrap_or_else(|| panic!("{}: no constant {name}", shader.stem));
            assert_eq!(&got, value, "{}: {name}", shader.stem);
        }
    }
}

#[test]
fn every_stage_has_a_cpu_stage_and_every_file_is_used() {
    let mut files: Vec<String> = fs_err::read_dir(root().join("shaders"))
        .expect("the folder of shaders")
        .filter_map(|entry| {
            let path = entry.expect("an entry").path();
            let wgsl = path.extension().is_some_and(|extension| extension == "wgsl");
            wgsl.then(|| path.file_stem().expect("a stem").to_string_lossy().into_owned())
        })
        .collect();
    files.sort();
    let mut stems: Vec<_> = SHADERS.iter().map(|shader| shader.stem.to_owned()).collect();
    stems.sort();
    stems.dedup();
    assert_eq!(files, stems, "files in shaders/ against SHADERS");
    for stem in &stems {
        let twin = match stem.as_str() {
            "prefix_sum" | "emit_isects" => "cpu/bin",
            // The blend of a tile sorts it first.
            "tile_sort" => "cpu/rasterize",
            "depth_steps" => "levels",
            "photo_loss" | "exposure" | "pose" | "adam" => &format!("train/{stem}"),
            stem if stem.ends_with("_backward") => "cpu/backward",
            stem => &format!("cpu/{stem}"),
        };
        let stage = root().join(format!("crates/render/src/{twin}.rs"));
        assert!(stage.is_file(), "shaders/{stem}.wgsl has no {}", stage.display());
    }
}

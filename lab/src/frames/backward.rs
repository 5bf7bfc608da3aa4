//! Times of a frame with its backward pass: a step of refinement but for the loss and the rule that
//! moves the Gaussians.

use std::time::Instant;

use segsplat_testing::{backward, compare::gradient_errors, scenes::Random};
use serde_json::json;

use super::{Args, Drawing, Reference, generated::dump};
use crate::{
    error::{Error, Result},
    refine::RefineOptions,
    render::{
        DifferentiableRenderer, Kinds, RenderRequest,
        backward::{FrameGradients, Gradients},
        cpu::CpuRenderer,
        train::{TrainingPhoto, TrainingSet, TrainingStep},
    },
    rows::{Rows, median, ms},
    scene::{Gaussians, Photo},
};

/// Most Gaussians times pixels that the oracle is asked for.
const ORACLE_MAX: usize = 1 << 28;

/// Makes a row. The loss is linear in colour, by random numbers. `forward_ms` and `step_ms` are
/// calls: the Gaussians of a step are new ones each time, as a refinement makes them, and go up,
/// the frame comes down, the gradients by its pixels go up and those by the Gaussians come down.
/// `trained_ms` is a step of a refinement on the device, with its loss and Adam, of one photo;
/// `null` where the renderer takes none. `device` has the times of the kernels. The error is
/// relative, of all derivatives over 1e-6 of the largest of their kind, against the oracle or the
/// CPU kernel.
///
/// # Errors
/// `invalid_request` when an argument is out of range, and those of the renderer.
pub(crate) fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    args.check()?;
    let (gaussians, request) = args.scene()?;
    let request = RenderRequest { kinds: Kinds::COLOR, ..request };
    let (renderer, adapters) = args.setup.renderer(args.switches())?;
    let pixels = args.width() as usize * args.size as usize;
    let mut random = Random(3);
    let by = (0..pixels).map(|_| [(); 3].map(|()| random.range(-1.0, 1.0))).collect();
    let by = FrameGradients { color: Some(by), ..FrameGradients::default() };
    let mut found = Gradients::default();
    let frame = pass(&*renderer, &gaussians, &request, &by, &mut found)?;
    let drawing = Drawing { renderer: &*renderer, gaussians: &gaussians, request: &request };
    let (mut forward_ms, mut step_ms) = (Vec::new(), Vec::new());
    // In turn, so that a noisy machine is as noisy to both.
    for _ in 0..args.frames {
        forward_ms.extend(drawing.times(1)?);
        let moved = Gaussians::sanitize(gaussians.clone().into_raw())?.0;
        let begun = Instant::now();
        pass(&*renderer, &moved, &request, &by, &mut found)?;
        step_ms.push(ms(begun));
    }
    let trained_ms = trained(&*renderer, &gaussians, &request, args.frames)?;
    let device = renderer.backward_times(&gaussians, &request, &by)?;
    let errors = match args.compare {
        Reference::Cpu => {
            let mut want = Gradients::default();
            let cpu = CpuRenderer::new(args.setup.threads())?;
            pass(&cpu, &gaussians, &request, &by, &mut want)?;
            gradient_errors(&found, &want)
        }
        Reference::Oracle if gaussians.len().saturating_mul(pixels) <= ORACLE_MAX => {
            gradient_errors(&found, &backward::gradients(&gaussians, &request, &by)?)
        }
        Reference::Oracle => {
            let work = gaussians.len().saturating_mul(pixels);
            return Err(Error::limit("Gaussians times pixels of the oracle", work, ORACLE_MAX));
        }
    };
    if let Some(path) = &args.dump {
        let colors = by.color.as_deref().unwrap_or_default();
        let n = gaussians.len();
        let more: [(&str, [usize; 2], &[f32]); 6] = [
            ("by_color", [pixels, 3], colors.as_flattened()),
            ("by_means", [n, 3], found.means.as_flattened()),
            ("by_quats", [n, 4], found.quats.as_flattened()),
            ("by_scales", [n, 3], found.scales.as_flattened()),
            ("by_opacities", [n, 1], &found.opacities),
            ("by_sh", [n, 3 * gaussians.sh_count()], found.sh.as_flattened()),
        ];
        dump(path, &gaussians, &request, &frame, &more)?;
    }
    let at = |share: f64| errors.get((share * (errors.len().max(1) - 1) as f64) as usize);
    let row = json!({
        "renderer": renderer.name(),
        "adapters": adapters,
        "gaussians": gaussians.len(),
        "width": args.width(),
        "height": args.size,
        "frames": args.frames,
        "visible": frame.stats.visible,
        "intersections": frame.stats.intersections,
        "forward_ms": median(forward_ms),
        "step_ms": median(step_ms),
        "trained_ms": trained_ms,
        "device": device,
    });
    let numbers = errors.len();
    rows.push(json!({ "median": at(0.5), "p99": at(0.99), "numbers": numbers }), row)
}

/// Median milliseconds of a step of the renderer's trainer towards a photo of random colours.
fn trained(
    renderer: &dyn DifferentiableRenderer,
    gaussians: &Gaussians,
    request: &RenderRequest,
    steps: usize,
) -> Result<Option<f64>> {
    let (lens, mut random) = (request.lens(), Random(5));
    let bytes = 3 * lens.width as usize * lens.height as usize;
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0..255")]
    let rgb = (0..bytes).map(|_| random.range(0.0, 255.0) as u8).collect();
    let photo = Photo { width: lens.width, height: lens.height, rgb, valid: None };
    let photos = vec![TrainingPhoto { photo: &photo, request: request.clone(), pose: 0 }];
    let ssim_share = RefineOptions::default().ssim_share;
    let streamed = Vec::new();
    let set = TrainingSet { gaussians, photos, streamed, ssim_share, gaussians_max: 0 };
    let Some(mut trainer) = renderer.trainer(&set, u64::MAX)? else { return Ok(None) };
    let step = TrainingStep { exposure: 5e-3, ..TrainingStep::default() };
    let mut times = Vec::new();
    for _ in 0..=steps {
        let begun = Instant::now();
        trainer.step(&[0], &step)?;
        times.push(ms(begun));
    }
    // The first finds how much room a step needs.
    Ok(Some(median(times.split_off(1))))
}

/// A frame and its backward pass.
fn pass(
    renderer: &dyn DifferentiableRenderer,
    gaussians: &Gaussians,
    request: &RenderRequest,
    by: &FrameGradients,
    found: &mut Gradients,
) -> Result<crate::render::Frame> {
    renderer.backward(gaussians, request, &mut |_| Ok(by.clone()), found)
}

// Every struct that host and shaders share. crates/render/src/gpu/buffers.rs has the same structs,
// and a test compares them.

// Camera of one view relative to the scene's origin, and the band of tile rows to draw.
struct View {
    // Rows of the rotation world to camera; w is 0.
    rotation_x: vec4<f32>,
    rotation_y: vec4<f32>,
    rotation_z: vec4<f32>,
    // What f32 leaves out of rotation_z.
    rotation_z_low: vec4<f32>,
    // Camera centre relative to the origin, and what f32 leaves out of it.
    center: vec4<f32>,
    center_low: vec4<f32>,
    background: vec4<f32>,
    // A ray goes no farther when its transmittance is x or less; then y is behind it
    // (crates/render/src/budget.rs).
    ray_end: vec4<f32>,
    // Pixels.
    focal: vec2<f32>,
    principal: vec2<f32>,
    // t.x / t.z and t.y / t.z between which the Jacobian is taken.
    slope_min: vec2<f32>,
    slope_max: vec2<f32>,
    near: f32,
    width: u32,
    height: u32,
    tiles_x: u32,
    tiles_y: u32,
    // Tile rows row_start..row_end are drawn.
    row_start: u32,
    row_end: u32,
    gaussian_count: u32,
    // Coefficients a Gaussian.
    sh_count: u32,
    antialiased: u32,
    isect_capacity: u32,
    // Always 0, and no compiler knows it.
    zero: u32,
    // First word of each picture in `pictures`, or NO_PICTURE.
    color_start: u32,
    depth_start: u32,
    alpha_start: u32,
    blend_start: u32,
    // Rows of the table that is blended, and where they start in `table`.
    label_rows: u32,
    table_start: u32,
    // Entries that a pixel has room for, and where they start in `slots`.
    weight_slots: u32,
    slot_start: u32,
    // First tile in `starts`, `ends` and `lists`, and first tile pair.
    range_start: u32,
    pair_start: u32,
    // How colour is written: 0 f32, LEVELS_RGB three bytes, LEVELS_RGBA four with alpha. Rows start
    // at whole words.
    levels: u32,
    // Pictures of bytes, whose rows start at whole words: alpha in levels, the mask.
    alpha_byte_start: u32,
    mask_start: u32,
    // Depth in steps of 16 bits, whose rows start at whole words.
    steps_start: u32,
    // First cell in `backdrops`; NO_PICTURE: `background` is behind colour.
    backdrop_start: u32,
    // Light that must pass the Gaussians for the backdrop to show.
    room_min: f32,
    // Least coverage that a mask selects.
    coverage_floor: f32,
    // Larger focal length over OWN_SIZE.
    own_focal: f32,
    // Photos of the view, and where they start in `sources`.
    source_count: u32,
    source_start: u32,
    // World ray of the first pixel's centre, and its change to the next column and row.
    ray_first: vec4<f32>,
    ray_across: vec4<f32>,
    ray_down: vec4<f32>,
    // Inner normals of the planes through the camera beyond which nothing touches the picture; w:
    // how far a scale of 1 moves them.
    sides: array<vec4<f32>, 4>,
    // A ball around the cameras of the photos; w is its radius.
    photos: vec4<f32>,
    // What a magnified view adds to a scale at most, for each unit of the distance from a photo.
    photos_widen: f32,
    // Blocks of the scene; 0: every Gaussian is projected.
    block_count: u32,
    // How far a Gaussian may be from the merged one that stands for it, for each unit of depth.
    detail: f32,
    // Not used: a row has a multiple of four.
    rest: u32,
}

// A photo that Gaussians were seen in.
struct Source {
    // Camera centre from the origin.
    center: vec3<f32>,
    // 1 / focal length in pixels of the photo; 0 where nothing is known.
    scale: f32,
    // Axis of the camera.
    axis: vec3<f32>,
    // BEHIND, LEFT_OUT, or 0: its Gaussians are in front.
    layer: u32,
}

// Gaussians that are close together.
struct Block {
    // Middle of the box of their centres.
    center: vec3<f32>,
    // Largest scale.
    reach: f32,
    // Half the sides of the box.
    half: vec3<f32>,
    // How far a Gaussian of the scene is at most from the one that stands for it here; under 0:
    // they are the scene's own.
    error: f32,
    // The block of merged Gaussians that stands for this one, if there is one of that number.
    parent: u32,
    // Not used.
    rest: array<u32, 3>,
}

struct Gaussian {
    mean: vec3<f32>,
    opacity: f32,
    // wxyz, unit.
    quat: vec4<f32>,
    scale: vec3<f32>,
    // Its photo in the lower half. In the upper half that of an f32: opacities that it stands for,
    // in sum, if it is merged; else 0.
    source: u32,
}

// A Gaussian on the picture. With d = pixel - mean, half the squared Mahalanobis distance is
// (conic_x (d.x - conic_shear d.y))² + (conic_y d.y)².
struct Footprint {
    mean: vec2<f32>,
    conic_shear: f32,
    conic_x: f32,
    conic_y: f32,
    // The largest half squared distance at which alpha is ALPHA_MIN, with slack.
    power_max: f32,
    opacity: f32,
    // Under 0: it is behind all that are over 0. The bits are the sort key.
    depth: f32,
}

// What one view found out on the way.
struct Plan {
    // Gaussian-tile pairs at work: 0 when `needed` exceeds the capacity.
    isects: u32,
    // Pairs there are; u32::MAX when more than that.
    needed: u32,
    // Gaussians that touch the whole picture.
    visible: atomic<u32>,
    // Bits of the largest depth, where depth is asked for in steps.
    farthest: atomic<u32>,
    // Rows that cull has left.
    rows: atomic<u32>,
}

// A step of training.
struct Training {
    // How far numbers move in it.
    means: f32,
    quats: f32,
    scales: f32,
    opacities: f32,
    // Harmonics of degree 0, and of higher ones.
    sh: f32,
    sh_rest: f32,
    exposure: f32,
    // Gaussians under this opacity are dropped.
    opacity_min: f32,
    // Share of SSIM in the loss.
    ssim_share: f32,
    // The photo, and its first pixel in `photos`.
    photo: u32,
    photo_start: u32,
    // Whether pixels say how far they are from the photo, not what the loss is by them.
    blames: u32,
}

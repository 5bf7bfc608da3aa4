//! `quality=fast`: today no renderer has a faster way, so its views are the exact ones.

use segsplat_render::{Quality, RenderRequest, Renderer};

use crate::common::{both_kernels, cpu};
use segsplat_testing::scenes::{request, two_views};

#[test]
fn fast_is_exact() {
    let cpu = cpu();
    let all = both_kernels().map(|gpu| gpu as &dyn Renderer).chain([&cpu as &dyn Renderer]);
    for renderer in all {
        let (gaussians, camera) = two_views(24, 9);
        let [exact, fast] = [Quality::Exact, Quality::Fast].map(|quality| {
            let ask = RenderRequest { quality, ..request(camera) };
            renderer.render(&gaussians, &ask).expect("a frame")
        });
        assert!(fast == exact, "{}", renderer.name());
    }
}

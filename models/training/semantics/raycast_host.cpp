// C door to ../geometry/raycast.h on the CPU: colour with soft shadows, depth, and which instance a
// pixel's centre sees. Built by eval_scenes.py: g++ -O3 -shared -fPIC -pthread.
#include <algorithm>
#include <cstring>
#include <thread>
#include <vector>
#include "../geometry/raycast.h"

namespace {
Tri load_tri(const float* p) {
  Tri t;
  for (int i = 0; i < 3; ++i) {
    t.p[i] = p[i]; t.e1[i] = p[3 + i]; t.e2[i] = p[6 + i]; t.rgb[i] = p[15 + i];
  }
  for (int i = 0; i < 6; ++i) t.uv[i] = p[9 + i];
  t.tex = (int)p[18]; t.slot = (int)p[19];
  return t;
}

struct World {
  std::vector<Node> nodes;
  std::vector<Tri> tris;
  std::vector<int> roots;
};

float centre(const float* t, int ax) { return 3 * t[ax] + t[3 + ax] + t[6 + ax]; }

// Splits at the median of the longest axis down to four triangles.
void build(World& w, const float* rows, const long long* ranges, int meshes) {
  std::vector<int> order(ranges[meshes]);
  for (size_t i = 0; i < order.size(); ++i) order[i] = (int)i;
  struct Job { int node, a, b; };
  for (int m = 0; m < meshes; ++m) {
    w.roots.push_back((int)w.nodes.size());
    w.nodes.push_back(Node());
    std::vector<Job> jobs{{(int)w.nodes.size() - 1, (int)ranges[m], (int)ranges[m + 1]}};
    while (!jobs.empty()) {
      Job j = jobs.back(); jobs.pop_back();
      Node n;
      for (int c = 0; c < 3; ++c) { n.lo[c] = 1e30f; n.hi[c] = -1e30f; }
      for (int k = j.a; k < j.b; ++k) {
        const float* t = rows + 20LL * order[k];
        for (int c = 0; c < 3; ++c) {
          float p0 = t[c], p1 = t[c] + t[3 + c], p2 = t[c] + t[6 + c];
          n.lo[c] = std::min(n.lo[c], std::min(p0, std::min(p1, p2)) - 1e-5f);
          n.hi[c] = std::max(n.hi[c], std::max(p0, std::max(p1, p2)) + 1e-5f);
        }
      }
      if (j.b - j.a <= 4) { n.first = j.a; n.count = j.b - j.a; w.nodes[j.node] = n; continue; }
      int ax = 0;
      for (int c = 1; c < 3; ++c) if (n.hi[c] - n.lo[c] > n.hi[ax] - n.lo[ax]) ax = c;
      int mid = (j.a + j.b) / 2;
      std::nth_element(order.begin() + j.a, order.begin() + mid, order.begin() + j.b,
                       [&](int a, int b) { return centre(rows + 20LL * a, ax) < centre(rows + 20LL * b, ax); });
      n.first = (int)w.nodes.size(); n.count = 0; w.nodes[j.node] = n;
      w.nodes.push_back(Node()); w.nodes.push_back(Node());
      jobs.push_back({n.first, j.a, mid}); jobs.push_back({n.first + 1, mid, j.b});
    }
  }
  for (int i : order) w.tris.push_back(load_tri(rows + 20LL * i));
}

// A number in [0, 1) from a pixel, a sample and a seed: the same on every machine.
float noise(unsigned x, unsigned y, unsigned k) {
  unsigned h = x * 374761393u + y * 668265263u + k * 2246822519u;
  h = (h ^ (h >> 13)) * 1274126177u;
  return ((h ^ (h >> 16)) & 0xffffffu) / 16777216.0f;
}
}  // namespace

extern "C" {
void* world_new(const float* rows, const long long* ranges, int meshes) {
  World* w = new World();
  build(*w, rows, ranges, meshes);
  return w;
}
void world_free(void* w) { delete (World*)w; }

// insts: count rows of 27 floats (inv 12, mesh, tex 6, tint 3, show, repeat, spec, casts, light size).
// light: l1 3, l2 3, c1 3, c2 3, amb. cam: camera_to_world 3x4 then fx fy cx cy. No rgb: no colour.
void render(void* world, const float* in, int count, const float* light, const uint8_t* bank_data,
            int tex_size, int levels, const float* cam, int width, int height, int threads,
            uint8_t* rgb, float* depth, int32_t* ids) {
  const World& w = *(World*)world;
  std::vector<Inst> insts(count);
  std::vector<char> casts(count);
  for (int i = 0; i < count; ++i) {
    const float* p = in + 27LL * i;
    memcpy(insts[i].inv, p, 12 * 4);
    insts[i].root = w.roots[(int)p[12]];
    for (int k = 0; k < 6; ++k) insts[i].tex[k] = (int)p[13 + k];
    for (int k = 0; k < 3; ++k) insts[i].tint[k] = p[19 + k];
    insts[i].show = p[22]; insts[i].repeat = p[23]; insts[i].spec = p[24];
    casts[i] = p[25] > 0.5f;
  }
  // Shadows are cast by a scene of its own: the room never stands in the light.
  std::vector<Inst> blockers;
  for (int i = 0; i < count; ++i) if (casts[i]) blockers.push_back(insts[i]);
  Scene s, dark;
  s.first = 0; s.count = count;
  memcpy(s.l1, light, 12); memcpy(s.l2, light + 3, 12); memcpy(s.c1, light + 6, 12); memcpy(s.c2, light + 9, 12);
  s.amb = light[12];
  dark = s; dark.count = (int)blockers.size();
  float spread = in[26];
  Bank bank; bank.data = bank_data; bank.size = tex_size; bank.levels = levels; bank.stride = 0;
  for (int l = 0; l < levels; ++l) bank.stride += 3LL * (tex_size >> l) * (tex_size >> l);

  auto row = [&](int y) {
    for (int x = 0; x < width; ++x) {
      V3 o = v3(cam[3], cam[7], cam[11]), acc = v3(0, 0, 0);
      float fx = cam[12], fy = cam[13], cx = cam[14], cy = cam[15];
      long long at = (long long)y * width + x;
      for (int k = rgb ? 0 : 4; k < 5; ++k) {
        float sx = k == 4 ? 0.5f : (k & 1) * 0.5f + 0.25f, sy = k == 4 ? 0.5f : (k >> 1) * 0.5f + 0.25f;
        float dx = (x + sx - cx) / fx, dy = (y + sy - cy) / fy;
        float norm = sqrtf(dx * dx + dy * dy + 1.0f), iz = 1.0f / norm;
        float ix = dx * iz, iy = dy * iz;
        V3 d = v3(cam[0] * ix + cam[1] * iy + cam[2] * iz, cam[4] * ix + cam[5] * iy + cam[6] * iz,
                  cam[8] * ix + cam[9] * iy + cam[10] * iz);
        Hit h = trace(s, insts.data(), w.nodes.data(), w.tris.data(), o, d);
        if (k == 4) { depth[at] = fminf(h.t, 1e6f) * iz; ids[at] = h.inst; break; }
        V3 c = shade(s, insts.data(), w.tris.data(), bank, h, o, d, iz / fx);
        if (h.inst >= 0) {
          V3 p = o + d * (h.t * 0.999f);
          float lit = 0;
          for (int j = 0; j < 3; ++j) {
            V3 to = v3(s.l1[0] + spread * (noise(x, y, k * 9 + j) - 0.5f), s.l1[1] + spread * (noise(x, y, k * 9 + 3 + j) - 0.5f),
                       s.l1[2] + spread * (noise(x, y, k * 9 + 6 + j) - 0.5f)) - p;
            float reach = len(to);
            Hit b = trace(dark, blockers.data(), w.nodes.data(), w.tris.data(), p, to * (1.0f / reach));
            lit += b.t < reach ? 0.0f : 1.0f / 3.0f;
          }
          c = c * (0.55f + 0.45f * lit);
        }
        acc = acc + c * 0.25f;
      }
      float v[3] = {acc.x, acc.y, acc.z};
      for (int c = 0; rgb && c < 3; ++c) {
        rgb[at * 3 + c] = (uint8_t)(fminf(fmaxf(v[c], 0.0f), 1.0f) * 255.0f + 0.5f);
      }
    }
  };
  std::vector<std::thread> pool;
  for (int t = 0; t < threads; ++t) {
    pool.emplace_back([&, t] { for (int y = t; y < height; y += threads) row(y); });
  }
  for (auto& t : pool) t.join();
}
}

// PyTorch door to raycast.h: scenes as packed float/int tensors in, pictures and depth out.
#include <torch/extension.h>
#include <algorithm>
#include <vector>
#include "raycast.h"

// tris: [T,20] (p e1 e2 uv rgb tex slot as floats), ranges: [M+1] triangle range of each mesh.
// Gives nodes [n, 8], reordered tris, roots [M].
std::vector<torch::Tensor> build_bvh(torch::Tensor tris, torch::Tensor ranges) {
  auto T = tris.contiguous(); auto R = ranges.contiguous();
  const float* tp = T.data_ptr<float>(); const int64_t* rp = R.data_ptr<int64_t>();
  std::vector<Node> nodes; std::vector<int> order(T.size(0)); std::vector<int> roots;
  for (size_t i = 0; i < order.size(); ++i) order[i] = (int)i;
  for (int m = 0; m + 1 < R.size(0); ++m) {
    roots.push_back((int)nodes.size());
    struct Job { int node, a, b; };
    nodes.push_back(Node());
    std::vector<Job> jobs{{(int)nodes.size() - 1, (int)rp[m], (int)rp[m + 1]}};
    while (!jobs.empty()) {
      Job j = jobs.back(); jobs.pop_back();
      float lo[3] = {1e30f, 1e30f, 1e30f}, hi[3] = {-1e30f, -1e30f, -1e30f};
      for (int k = j.a; k < j.b; ++k) {
        const float* t = tp + 20LL * order[k];
        for (int c = 0; c < 3; ++c) {
          float p0 = t[c], p1 = t[c] + t[3 + c], p2 = t[c] + t[6 + c];
          lo[c] = std::min(lo[c], std::min(p0, std::min(p1, p2)));
          hi[c] = std::max(hi[c], std::max(p0, std::max(p1, p2)));
        }
      }
      Node n;
      for (int c = 0; c < 3; ++c) { n.lo[c] = lo[c] - 1e-5f; n.hi[c] = hi[c] + 1e-5f; }
      if (j.b - j.a <= 4) { n.first = j.a; n.count = j.b - j.a; nodes[j.node] = n; continue; }
      int ax = 0;
      for (int c = 1; c < 3; ++c) if (hi[c] - lo[c] > hi[ax] - lo[ax]) ax = c;
      int mid = (j.a + j.b) / 2;
      std::nth_element(order.begin() + j.a, order.begin() + mid, order.begin() + j.b, [&](int a, int b) {
        const float *ta = tp + 20LL * a, *tb = tp + 20LL * b;
        return 3 * ta[ax] + ta[3 + ax] + ta[6 + ax] < 3 * tb[ax] + tb[3 + ax] + tb[6 + ax];
      });
      n.first = (int)nodes.size(); n.count = 0; nodes[j.node] = n;
      nodes.push_back(Node()); nodes.push_back(Node());
      jobs.push_back({n.first, j.a, mid}); jobs.push_back({n.first + 1, mid, j.b});
    }
  }
  auto on = torch::empty({(int64_t)nodes.size(), 8}, torch::kFloat32);
  memcpy(on.data_ptr<float>(), nodes.data(), nodes.size() * sizeof(Node));
  auto idx = torch::empty({(int64_t)order.size()}, torch::kInt64);
  for (size_t i = 0; i < order.size(); ++i) idx.data_ptr<int64_t>()[i] = order[i];
  auto orr = torch::empty({(int64_t)roots.size()}, torch::kInt32);
  for (size_t i = 0; i < roots.size(); ++i) orr.data_ptr<int>()[i] = roots[i];
  return {on, T.index_select(0, idx), orr};
}

HD Tri load_tri(const float* p) {
  Tri t;
  for (int i = 0; i < 3; ++i) { t.p[i] = p[i]; t.e1[i] = p[3 + i]; t.e2[i] = p[6 + i]; t.rgb[i] = p[15 + i]; }
  for (int i = 0; i < 6; ++i) t.uv[i] = p[9 + i];
  t.tex = (int)p[18]; t.slot = (int)p[19];
  return t;
}

__global__ void pack_tris(const float* in, Tri* out, int n) {
  int i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i < n) out[i] = load_tri(in + 20LL * i);
}

// inst: [S*I, 26] floats: inv(12) root tex(6) tint(3) show repeat spec pad
__global__ void pack_insts(const float* in, Inst* out, int n) {
  int i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i >= n) return;
  const float* p = in + 26LL * i; Inst q;
  for (int k = 0; k < 12; ++k) q.inv[k] = p[k];
  q.root = (int)p[12];
  for (int k = 0; k < 6; ++k) q.tex[k] = (int)p[13 + k];
  for (int k = 0; k < 3; ++k) q.tint[k] = p[19 + k];
  q.show = p[22]; q.repeat = p[23]; q.spec = p[24];
  out[i] = q;
}

__global__ void render_kernel(const float* scenes, int per, const Inst* insts, const Node* nodes,
                              const Tri* tris, Bank bank, const float* cams, int views, int W, int H,
                              float* rgb, float* depth, int* ids) {
  int x = blockIdx.x * 16 + threadIdx.x, y = blockIdx.y * 8 + threadIdx.y, v = blockIdx.z;
  if (x >= W || y >= H) return;
  int si = v / views;
  const float* sp = scenes + 13LL * si; Scene s;
  s.first = si * per; s.count = per;
  for (int k = 0; k < 3; ++k) { s.l1[k] = sp[k]; s.l2[k] = sp[3 + k]; s.c1[k] = sp[6 + k]; s.c2[k] = sp[9 + k]; }
  s.amb = sp[12];
  float c[3], z; int id;
  render_pixel(s, insts, nodes, tris, bank, cams + 16LL * v, x, y, c, &z, &id);
  long long at = (long long)y * W + x, hw = (long long)H * W;
  for (int k = 0; k < 3; ++k) rgb[(v * 3LL + k) * hw + at] = c[k];
  depth[v * hw + at] = z;
  ids[v * hw + at] = id;
}

// scenes [S,13], inst [S,I,26], nodes [n,8], tris [T,20], bank u8 [X, stride], cams [S,V,16].
// Gives colour [S,V,3,H,W], depth [S,V,H,W] and ids [S,V,H,W] (see `part_id`).
std::vector<torch::Tensor> render(torch::Tensor scenes, torch::Tensor inst, torch::Tensor nodes,
                                  torch::Tensor packed, torch::Tensor bank, int64_t size,
                                  int64_t levels, torch::Tensor cams, int64_t H, int64_t W) {
  int S = scenes.size(0), I = inst.size(1), V = cams.size(1);
  auto f = scenes.options();
  auto insts = torch::empty({(int64_t)S * I * (int64_t)sizeof(Inst)}, f.dtype(torch::kUInt8));
  auto ci = inst.contiguous(), cs = scenes.contiguous(), cc = cams.contiguous();
  pack_insts<<<(S * I + 127) / 128, 128>>>(ci.data_ptr<float>(), (Inst*)insts.data_ptr<uint8_t>(), S * I);
  auto rgb = torch::empty({S, V, 3, H, W}, f), depth = torch::empty({S, V, H, W}, f);
  auto ids = torch::empty({S, V, H, W}, f.dtype(torch::kInt32));
  Bank b; b.data = bank.data_ptr<uint8_t>(); b.size = size; b.levels = levels; b.stride = bank.size(1);
  render_kernel<<<dim3((W + 15) / 16, (H + 7) / 8, S * V), dim3(16, 8)>>>(
      cs.data_ptr<float>(), I, (const Inst*)insts.data_ptr<uint8_t>(), (const Node*)nodes.data_ptr<float>(),
      (const Tri*)packed.data_ptr<uint8_t>(), b, cc.data_ptr<float>(), V, W, H, rgb.data_ptr<float>(),
      depth.data_ptr<float>(), ids.data_ptr<int>());
  TORCH_CHECK(cudaGetLastError() == cudaSuccess, "raycast launch failed");
  return {rgb, depth, ids};
}

torch::Tensor pack(torch::Tensor tris) {
  int n = tris.size(0);
  auto out = torch::empty({(int64_t)n * (int64_t)sizeof(Tri)}, tris.options().dtype(torch::kUInt8));
  pack_tris<<<(n + 127) / 128, 128>>>(tris.data_ptr<float>(), (Tri*)out.data_ptr<uint8_t>(), n);
  return out;
}

PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {
  m.def("build_bvh", &build_bvh);
  m.def("pack", &pack);
  m.def("render", &render);
}

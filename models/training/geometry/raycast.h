// Ray caster of the training scenes: instanced triangle meshes with a BVH each, mip-mapped
// textures, two lights. Plain C++ so that it can be checked on a CPU; CUDA calls the same code.
// One pixel = 4 stratified shading rays + 1 centre ray for the depth (z of the camera frame).
#pragma once
#include <cmath>
#include <cstdint>
#ifdef __CUDACC__
#define HD __host__ __device__ __forceinline__
#else
#define HD inline
#endif

struct V3 { float x, y, z; };
HD V3 v3(float x, float y, float z) { V3 r; r.x = x; r.y = y; r.z = z; return r; }
HD V3 operator+(V3 a, V3 b) { return v3(a.x + b.x, a.y + b.y, a.z + b.z); }
HD V3 operator-(V3 a, V3 b) { return v3(a.x - b.x, a.y - b.y, a.z - b.z); }
HD V3 operator*(V3 a, float s) { return v3(a.x * s, a.y * s, a.z * s); }
HD float dot(V3 a, V3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
HD V3 cross(V3 a, V3 b) {
  return v3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}
HD float len(V3 a) { return sqrtf(dot(a, a)); }

// Node: bounds, then (first, count): count > 0 leaf of triangles, else children first, first+1.
struct Node { float lo[3], hi[3]; int first, count; };
// Triangle: corner, two edges, three uv pairs, colour, texture (-1 none), slot 0..5.
struct Tri { float p[3], e1[3], e2[3], uv[6], rgb[3]; int tex, slot; };
// Instance: world->local affine (row-major 3x4), mesh root node, slot textures (-2 the mesh's own,
// -1 none), tint, how much texture shows, uv repeat, specular.
struct Inst { float inv[12]; int root; int tex[6]; float tint[3]; float show, repeat, spec; };
// Scene: instances, lights, ambient.
struct Scene { int first, count; float l1[3], l2[3], c1[3], c2[3], amb; };

struct Bank {            // square 8-bit textures of one size with their mips, one after another
  const uint8_t* data;
  int size, levels;
  long long stride;      // bytes of one texture with all its mips
};

HD V3 fetch(const Bank& b, int tex, int level, float u, float v) {
  int s = b.size >> level;
  long long off = (long long)tex * b.stride;
  for (int l = 0, w = b.size; l < level; ++l, w >>= 1) off += 3LL * w * w;
  float x = (u - floorf(u)) * s - 0.5f, y = (v - floorf(v)) * s - 0.5f;
  int x0 = (int)floorf(x), y0 = (int)floorf(y);
  float fx = x - x0, fy = y - y0;
  V3 acc = v3(0, 0, 0);
  for (int k = 0; k < 4; ++k) {
    int xi = (x0 + (k & 1) + s) % s, yi = (y0 + (k >> 1) + s) % s;
    const uint8_t* p = b.data + off + 3LL * (yi * s + xi);
    float w = ((k & 1) ? fx : 1 - fx) * ((k >> 1) ? fy : 1 - fy);
    acc = acc + v3(p[0], p[1], p[2]) * (w / 255.0f);
  }
  return acc;
}

HD V3 sample(const Bank& b, int tex, float lod, float u, float v) {
  lod = fminf(fmaxf(lod, 0.0f), (float)(b.levels - 1));
  int l = (int)lod;
  float f = lod - l;
  V3 c = fetch(b, tex, l, u, v);
  if (f > 0.01f && l + 1 < b.levels) c = c * (1 - f) + fetch(b, tex, l + 1, u, v) * f;
  return c;
}

struct Hit { float t, u, v; int inst, tri; };

HD bool slab(const Node& n, V3 o, V3 inv_d, float tmax) {
  float a0 = (n.lo[0] - o.x) * inv_d.x, a1 = (n.hi[0] - o.x) * inv_d.x;
  float t0 = fminf(a0, a1), t1 = fmaxf(a0, a1);
  a0 = (n.lo[1] - o.y) * inv_d.y; a1 = (n.hi[1] - o.y) * inv_d.y;
  t0 = fmaxf(t0, fminf(a0, a1)); t1 = fminf(t1, fmaxf(a0, a1));
  a0 = (n.lo[2] - o.z) * inv_d.z; a1 = (n.hi[2] - o.z) * inv_d.z;
  t0 = fmaxf(t0, fminf(a0, a1)); t1 = fminf(t1, fmaxf(a0, a1));
  return t1 >= fmaxf(t0, 0.0f) && t0 < tmax;
}

HD float safe_inv(float d) { return 1.0f / (fabsf(d) < 1e-12f ? (d < 0 ? -1e-12f : 1e-12f) : d); }

HD V3 to_local(const Inst& q, V3 p, float w) {
  return v3(q.inv[0] * p.x + q.inv[1] * p.y + q.inv[2] * p.z + q.inv[3] * w,
            q.inv[4] * p.x + q.inv[5] * p.y + q.inv[6] * p.z + q.inv[7] * w,
            q.inv[8] * p.x + q.inv[9] * p.y + q.inv[10] * p.z + q.inv[11] * w);
}

HD Hit trace(const Scene& s, const Inst* insts, const Node* nodes, const Tri* tris, V3 o, V3 d) {
  Hit h; h.t = 1e30f; h.inst = -1; h.tri = -1; h.u = h.v = 0;
  for (int i = s.first; i < s.first + s.count; ++i) {
    const Inst& q = insts[i];
    if (q.root < 0) continue;
    V3 lo = to_local(q, o, 1.0f), ld = to_local(q, d, 0.0f);
    V3 inv = v3(safe_inv(ld.x), safe_inv(ld.y), safe_inv(ld.z));
    int stack[32]; int top = 0; stack[top++] = q.root;
    while (top > 0) {
      const Node n = nodes[stack[--top]];
      if (!slab(n, lo, inv, h.t)) continue;
      if (n.count == 0) { if (top < 31) { stack[top++] = n.first; stack[top++] = n.first + 1; } continue; }
      for (int k = n.first; k < n.first + n.count; ++k) {
        const Tri& t = tris[k];
        V3 e1 = v3(t.e1[0], t.e1[1], t.e1[2]), e2 = v3(t.e2[0], t.e2[1], t.e2[2]);
        V3 pv = cross(ld, e2);
        float det = dot(e1, pv);
        if (fabsf(det) < 1e-14f) continue;
        float id = 1.0f / det;
        V3 tv = lo - v3(t.p[0], t.p[1], t.p[2]);
        float u = dot(tv, pv) * id;
        if (u < 0 || u > 1) continue;
        V3 qv = cross(tv, e1);
        float v = dot(ld, qv) * id;
        if (v < 0 || u + v > 1) continue;
        float tt = dot(e2, qv) * id;
        if (tt > 1e-4f && tt < h.t) { h.t = tt; h.u = u; h.v = v; h.inst = i; h.tri = k; }
      }
    }
  }
  return h;
}

HD V3 shade(const Scene& s, const Inst* insts, const Tri* tris, const Bank& bank, const Hit& h,
            V3 o, V3 d, float pixel_angle) {
  if (h.inst < 0) return v3(0.5f, 0.5f, 0.5f);
  const Inst& q = insts[h.inst];
  const Tri& t = tris[h.tri];
  V3 e1 = v3(t.e1[0], t.e1[1], t.e1[2]), e2 = v3(t.e2[0], t.e2[1], t.e2[2]);
  V3 nl = cross(e1, e2);
  // Normals go to the world by the transpose of world->local; |cofactor| gives the area's change.
  V3 n = v3(q.inv[0] * nl.x + q.inv[4] * nl.y + q.inv[8] * nl.z,
            q.inv[1] * nl.x + q.inv[5] * nl.y + q.inv[9] * nl.z,
            q.inv[2] * nl.x + q.inv[6] * nl.y + q.inv[10] * nl.z);
  V3 r0 = v3(q.inv[0], q.inv[1], q.inv[2]), r1 = v3(q.inv[4], q.inv[5], q.inv[6]),
     r2 = v3(q.inv[8], q.inv[9], q.inv[10]);
  float det = fabsf(dot(r0, cross(r1, r2)));
  float area = len(n) / fmaxf(det, 1e-20f);  // world area of the parallelogram
  n = n * (1.0f / fmaxf(len(n), 1e-20f));
  if (dot(n, d) > 0) n = n * -1.0f;
  float u = t.uv[0] + (t.uv[2] - t.uv[0]) * h.u + (t.uv[4] - t.uv[0]) * h.v;
  float v = t.uv[1] + (t.uv[3] - t.uv[1]) * h.u + (t.uv[5] - t.uv[1]) * h.v;
  float du1 = t.uv[2] - t.uv[0], dv1 = t.uv[3] - t.uv[1], du2 = t.uv[4] - t.uv[0], dv2 = t.uv[5] - t.uv[1];
  float uva = fabsf(du1 * dv2 - du2 * dv1);
  int tex = q.tex[t.slot] == -2 ? t.tex : q.tex[t.slot];
  V3 base = q.tex[t.slot] == -2 ? v3(t.rgb[0], t.rgb[1], t.rgb[2]) : v3(1, 1, 1);
  V3 c = v3(base.x * q.tint[0], base.y * q.tint[1], base.z * q.tint[2]);
  if (tex >= 0) {
    float rep = q.tex[t.slot] == -2 ? 1.0f : q.repeat;
    float density = sqrtf(uva / fmaxf(area, 1e-20f)) * rep * bank.size;
    float cosv = fmaxf(fabsf(dot(n, d)), 0.1f);
    float lod = log2f(fmaxf(h.t * pixel_angle * 0.5f * density / sqrtf(cosv), 1e-6f));
    V3 x = sample(bank, tex, lod, u * rep, v * rep);
    c = v3(c.x * (1 - q.show) + x.x * base.x * q.show, c.y * (1 - q.show) + x.y * base.y * q.show,
           c.z * (1 - q.show) + x.z * base.z * q.show);
  }
  V3 L1 = v3(s.l1[0], s.l1[1], s.l1[2]), L2 = v3(s.l2[0], s.l2[1], s.l2[2]);
  V3 p = o + d * h.t;
  V3 w1 = L1 - p; w1 = w1 * (1.0f / fmaxf(len(w1), 1e-6f));
  V3 w2 = L2 - p; w2 = w2 * (1.0f / fmaxf(len(w2), 1e-6f));
  float k1 = 0.5f + 0.5f * dot(n, w1), k2 = 0.5f + 0.5f * dot(n, w2);
  V3 refl = d - n * (2 * dot(d, n));
  float sp = q.spec * powf(fmaxf(dot(refl, w1), 0.0f), 20.0f);
  return v3(fminf(c.x * (s.amb + s.c1[0] * k1 + s.c2[0] * k2) + sp, 1.0f),
            fminf(c.y * (s.amb + s.c1[1] * k1 + s.c2[1] * k2) + sp, 1.0f),
            fminf(c.z * (s.amb + s.c1[2] * k1 + s.c2[2] * k2) + sp, 1.0f));
}

// What the pixel's centre sees: -1 for nothing, else the instance's number in its scene in the low
// byte and, above it, 16 bits that tell parts of one instance apart (face, texture, colour).
HD int part_id(const Scene& s, const Tri* tris, const Hit& h) {
  if (h.inst < 0) return -1;
  const Tri& t = tris[h.tri];
  unsigned k = (unsigned)(t.slot + 1) * 2654435761u ^ (unsigned)(t.tex + 2) * 40503u;
  for (int c = 0; c < 3; ++c) k = (k ^ (unsigned)(t.rgb[c] * 255.0f)) * 16777619u;
  return (h.inst - s.first) | (int)((k ^ (k >> 16)) & 0xffffu) << 8;
}

// cam: camera_to_world 3x4 row-major (12) then fx fy cx cy in pixels. `id` may be null.
HD void render_pixel(const Scene& s, const Inst* insts, const Node* nodes, const Tri* tris,
                     const Bank& bank, const float* cam, int x, int y, float* rgb, float* depth,
                     int* id) {
  V3 o = v3(cam[3], cam[7], cam[11]), acc = v3(0, 0, 0);
  float fx = cam[12], fy = cam[13], cx = cam[14], cy = cam[15];
  for (int k = 0; k < 5; ++k) {
    float sx = k == 4 ? 0.5f : (k & 1) * 0.5f + 0.25f, sy = k == 4 ? 0.5f : (k >> 1) * 0.5f + 0.25f;
    if (k < 4) { sx += ((k >> 1) - 0.5f) * 0.25f; sy += ((k & 1) - 0.5f) * -0.25f; }
    float dx = (x + sx - cx) / fx, dy = (y + sy - cy) / fy;
    float norm = sqrtf(dx * dx + dy * dy + 1.0f);
    float ix = dx / norm, iy = dy / norm, iz = 1.0f / norm;
    V3 d = v3(cam[0] * ix + cam[1] * iy + cam[2] * iz, cam[4] * ix + cam[5] * iy + cam[6] * iz,
              cam[8] * ix + cam[9] * iy + cam[10] * iz);
    Hit h = trace(s, insts, nodes, tris, o, d);
    if (k == 4) {
      *depth = fminf(h.t, 1e6f) * iz;
      if (id) *id = part_id(s, tris, h);
    } else acc = acc + shade(s, insts, tris, bank, h, o, d, iz / fx) * 0.25f;
  }
  rgb[0] = acc.x; rgb[1] = acc.y; rgb[2] = acc.z;
}

// What surfaces and media do to light: as datagen/trace computes it.

// ---- Media: which solid fills a point that several share

const uint NO_SOLIDS = NESTED == 1 ? 0u : 255u;

uint with_solid(uint solids, int rank) { return NESTED == 1 ? solids | (1u << uint(rank)) : uint(rank); }
uint without_solid(uint solids, int rank) { return NESTED == 1 ? solids & ~(1u << uint(rank)) : NO_SOLIDS; }

int medium_of(uint solids) {
    if (solids == NO_SOLIDS) return -1;  // Air.
    if (NESTED == 0) return int(solids);
    uint lowest = solids & (~solids + 1u);
    return int(log2(float(lowest)) + 0.5);
}

int channel = 1;  // Whose light is followed: red, green or blue.

float index_of(int rank) { return rank < 0 ? 1.0 : of_object(rank, MEDIUM)[channel]; }
bool parts_colors(int rank) { return rank >= 0 && of_object(rank, MEDIUM).w > 0.0; }
vec3 absorption_of(int rank) { return rank < 0 ? vec3(0.0) : of_object(rank, MEDIUM + 1).xyz; }

// ---- What metal mirrors

uniform highp sampler2D tints;

// Texels count, where it has any: bilinear between their centres, the outermost ones beyond. Source: datagen/trace/surface_tables.py.
vec3 metal_color(int object, vec2 uv) {
    vec4 color = of_object(object, COLOR);
#if TINTS == 1
    ivec2 size = ivec2(of_object(object, TREE).zw);
    if (size.x > 0) {
        vec2 at = clamp(vec2(uv.x, 1.0 - uv.y) * vec2(size) - 0.5, vec2(0.0), vec2(size - 1));
        ivec2 low = ivec2(at), high = min(low + 1, size - 1);
        at -= vec2(low);
        int upper = int(color.w) + low.y * size.x, lower = int(color.w) + high.y * size.x;
        vec4 above = mix(fetch(tints, upper + low.x), fetch(tints, upper + high.x), at.x);
        color *= mix(above, mix(fetch(tints, lower + low.x), fetch(tints, lower + high.x), at.x), at.y);
    }
#endif
    return color.rgb;
}

// ---- Random numbers, as Mitsuba makes them

uvec2 tea(uint v0, uint v1) {
    uint sum = 0u;
    for (int i = 0; i < 4; i++) {
        sum += 0x9e3779b9u;
        v0 += ((v1 << 4) + 0xa341316cu) ^ (v1 + sum) ^ ((v1 >> 5) + 0xc8013ea4u);
        v1 += ((v0 << 4) + 0xad90777du) ^ (v0 + sum) ^ ((v0 >> 5) + 0x7e95761eu);
    }
    return uvec2(v0, v1);
}

float random(uint v0, uint v1) { return uintBitsToFloat((tea(v0, v1).y >> 9) | 0x3f800000u) - 1.0; }

// Which facet of a rough surface a ray chooses. Where glass is rough, each ray throws its own dice from the second
// surface on.
vec2 random_point(vec2 row, uint ray, int step) {
    uvec2 at = uvec2(2 * step, 2 * step + 1);
    if (ROUGH_GLASS == 1 && step > 0) return vec2(random(ray, tea(seed, at.x).x), random(ray, tea(seed, at.y).x));
    vec2 point = row + vec2(random(seed, at.x), random(seed, at.y));
    return point - floor(point);
}

// ---- Optics

// Fresnel's reflectance, and the cosine of the refracted ray: 0 where all light is reflected.
vec2 fresnel(float cos_i, float eta) {
    float cos_t2 = 1.0 - (1.0 - cos_i * cos_i) / (eta * eta);
    if (eta == 1.0) return vec2(0.0, cos_i);
    if (cos_t2 <= 0.0 || cos_i == 0.0) return vec2(1.0, 0.0);
    float cos_t = sqrt(cos_t2);
    float s = (cos_i - eta * cos_t) / (cos_i + eta * cos_t), p = (cos_t - eta * cos_i) / (cos_t + eta * cos_i);
    return vec2(0.5 * (s * s + p * p), cos_t);
}

// A visible facet of a rough surface, in the surface's frame. Source: datagen/render/facets.py.
struct Facet {
    mat3 frame;
    vec3 wi, m;
    float cosine, alpha;
};

Facet facet_towards(vec3 d, vec3 n, float alpha, vec2 u) {
    // Upright walls have the frame of 0 also where rounding made their normals lean down.
    float turn = n.z < -1e-6 ? -1.0 : 1.0, a = -1.0 / (turn + n.z), b = n.x * n.y * a;
    mat3 frame = mat3(turn * n.x * n.x * a + 1.0, turn * b, -turn * n.x, b, turn + n.y * n.y * a, -n.y, n);
    vec3 wi = -d * frame;
    vec3 stretched = normalize(vec3(alpha * wi.xy, max(wi.z, 1e-6)));
    float z = (1.0 - u.y) * (1.0 + stretched.z) - stretched.z;
    float sine = sqrt(max(1.0 - z * z, 0.0)), azimuth = 6.283185307179586 * u.x;
    vec3 cap = vec3(sine * cos(azimuth), sine * sin(azimuth), z) + stretched;
    vec3 m = normalize(vec3(alpha * cap.xy, max(cap.z, 1e-6)));
    return Facet(frame, wi, m, clamp(dot(wi, m), 0.0, 1.0), alpha);
}

float unshadowed(vec3 wo, float alpha) {
    return 2.0 / (1.0 + sqrt(1.0 + alpha * alpha * dot(wo.xy, wo.xy) / max(wo.z * wo.z, 1e-12)));
}

// The share of light that single facets keep. Source: datagen/render/albedo.py.
float albedo(float cosine, float alpha, float eta) {
    float contrast = (eta - 1.0) / (eta + 1.0);
    vec3 size = vec3(ALBEDO_INDICES, ALBEDO_ALPHAS, ALBEDO_COSINES);
    vec3 place = vec3(0.5 + 0.5 * sign(contrast) * sqrt(abs(contrast)), alpha, sqrt(cosine)) * (size - 1.0);
    vec3 low = min(floor(place), size - 2.0), share = place - low;
    float kept = 0.0;
    for (int corner = 0; corner < 8; corner++) {
        vec3 high = vec3(corner >> 2, corner >> 1 & 1, corner & 1), at = low + high, part = mix(1.0 - share, share, high);
        int index = int((at.x * size.y + at.y) * size.z + at.z);
        kept += part.x * part.y * part.z * fetch(weights, ALBEDO + index / 4)[index % 4];
    }
    return kept;
}

vec3 mirrored_by(Facet facet, out float shadowing) {
    vec3 wo = 2.0 * facet.cosine * facet.m - facet.wi;
    shadowing = wo.z > 0.0 ? unshadowed(wo, facet.alpha) : 0.0;
    return normalize(facet.frame * wo);
}

vec3 refracted_by(Facet facet, float cos_t, float eta, out float shadowing) {
    vec3 wo = facet.m * (facet.cosine / eta - cos_t) - facet.wi / eta;
    shadowing = wo.z < 0.0 ? unshadowed(wo, facet.alpha) : 0.0;
    return normalize(facet.frame * wo);
}

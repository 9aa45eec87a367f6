// Light paths and the networks that shade them, one ray a pixel: what datagen/trace and
// model/methods/light_path/net.py compute. The page defines, above this text, the numbers of model/web/scene.py.

uniform highp sampler2D nodes;      // Of both levels of the tree: four texels each, a box and where it leads, twice.
uniform highp sampler2D triangles;  // Three corners each; beside each its vertex.
uniform highp sampler2D vertices;   // Octahedral normal, uv.
uniform highp sampler2D objects;    // A row for each: where it stands, what it does to light, where its texels lie.
uniform highp sampler2D texels;
uniform highp sampler2D weights;    // Of the networks, then of the sky.
uniform highp sampler2D before;     // The sum of the frames before this one.

uniform vec3 camera_place;
uniform mat3 camera_turn;  // world_from_camera
uniform float focal;       // Pixels.
uniform vec2 size;         // Pixels.
uniform vec2 place;        // Of the ray in its pixel: right and down from the upper left corner.
uniform uint chunk;        // Pixels that share out the facets of rough surfaces among them.
uniform uint samples;      // Rays of each pixel that do.
uniform uint ray_sample;   // Which of these this frame is.
uniform uint seed;         // Of the facets.
uniform float keep;        // 1: add to the frames before; 0: begin.
uniform int task;          // 0: a picture; 1: which object is met, how far away, and by which normal.

out vec4 result;

const int OPAQUE = 0, DIELECTRIC = 1, THIN = 2, COATED = 3, METAL = 4;
const float OFFSET = 2e-6, MIN_THROUGHPUT = 1.0 / 512.0, FIRST_MIRROR = 16.0, FAR = 1e30;
const int SPARE_STEPS = 16, NO_FACE = -1;
const int INPUTS = 4 * FEATURE_TEXELS + 1 + 9 * SEES_DIRECTIONS + 6 * OCTAVES;
const int SLOT = 4 * FEATURE_TEXELS + 2;
const int GROUPS = HIDDEN / 4, STACK_GROUPS = STACK_HIDDEN / 4;
// Where the layers begin among the weights; each has four outputs beside each other for every input, then its biases.
const int FIRST = 0, FIRST_BIAS = FIRST + GROUPS * INPUTS;
const int SECOND = FIRST_BIAS + GROUPS, SECOND_BIAS = SECOND + GROUPS * HIDDEN;
const int THIRD = SECOND_BIAS + GROUPS, THIRD_BIAS = THIRD + HIDDEN;
const int S_FIRST = THIRD_BIAS + 1, S_FIRST_BIAS = S_FIRST + STACK_GROUPS * 6 * SLOT;
const int S_SECOND = S_FIRST_BIAS + STACK_GROUPS, S_SECOND_BIAS = S_SECOND + STACK_GROUPS * STACK_HIDDEN;
const int S_THIRD = S_SECOND_BIAS + STACK_GROUPS, S_THIRD_BIAS = S_THIRD + STACK_HIDDEN;
const int SKY = S_THIRD_BIAS + 1;

vec4 fetch(highp sampler2D table, int index) {
    return texelFetch(table, ivec2(index % TEXTURE_WIDTH, index / TEXTURE_WIDTH), 0);
}

vec4 of_object(int object, int column) { return texelFetch(objects, ivec2(column, object), 0); }

// Columns of `objects`.
const int TURN = 0, OPTICS = 3, COLOR = 4, TREE = 5, MEDIUM = 6, TEXTURE = 7;

// ---- Which surface a ray meets

struct Hit {
    float t;
    vec2 b;
    int face, object;
};

float enter(vec3 low, vec3 high, vec3 o, vec3 inverse, float nearest) {
    vec3 a = (low - o) * inverse, b = (high - o) * inverse;
    vec3 near = min(a, b), far = max(a, b);
    float t0 = max(max(near.x, near.y), max(near.z, 0.0));
    // Rounding must lose no box without thickness.
    float t1 = min(min(far.x, far.y), min(far.z, nearest)) * 1.0000005;
    return t0 <= t1 ? t0 : FAR;
}

vec3 inverse_of(vec3 d) {
    vec3 safe = mix(vec3(1e-20), d, vec3(greaterThan(abs(d), vec3(1e-20))));
    return 1.0 / safe;
}

void meet(int first, int count, int object, vec3 o, vec3 d, int left_face, int left_object, inout Hit hit) {
    for (int face = first; face < first + count; face++) {
        vec3 v0 = fetch(triangles, 3 * face).xyz;
        vec3 v1 = fetch(triangles, 3 * face + 1).xyz, v2 = fetch(triangles, 3 * face + 2).xyz;
        vec3 e1 = v0 - v1, e2 = v2 - v0, normal = cross(e2, e1), c = v0 - o, r = cross(c, d);
        float det = dot(normal, d), side = det < 0.0 ? -1.0 : 1.0;
        float u = dot(r, e2) * side, v = dot(r, e1) * side, t = dot(normal, c) * side;
        det = abs(det);
        if (u < 0.0 || v < 0.0 || u + v > det || t <= 0.0 || t >= hit.t * det || det == 0.0) continue;
        // A ray that leaves a face does not meet it again.
        if (face == left_face && object == left_object) continue;
        hit = Hit(t / det, vec2(u, v) / det, face, object);
    }
}

Hit find(vec3 o, vec3 d, int left_face, int left_object) {
    Hit hit = Hit(FAR, vec2(0.0), NO_FACE, 0);
    int stack[STACK];
    int waiting = 0, node = 0, object = -1;
    vec3 here = o, along = d, inverse = inverse_of(d);
    for (int guard = 0; guard < 1 << 16; guard++) {
        vec4 low0 = fetch(nodes, 4 * node), high0 = fetch(nodes, 4 * node + 1);
        vec4 low1 = fetch(nodes, 4 * node + 2), high1 = fetch(nodes, 4 * node + 3);
        float t0 = enter(low0.xyz, high0.xyz, here, inverse, hit.t), t1 = enter(low1.xyz, high1.xyz, here, inverse, hit.t);
        // What lies beside a box: where its faces begin, and how many there are; or its node, and 0.
        int next0 = int(low0.w), next1 = int(low1.w), count0 = int(high0.w), count1 = int(high1.w);
        if (t0 < FAR && count0 > 0) {
            if (object < 0) stack[waiting++] = -2 - next0;
            else meet(next0, count0, object, here, along, left_face, left_object, hit);
            t0 = FAR;
        }
        if (t1 < FAR && count1 > 0) {
            if (object < 0) stack[waiting++] = -2 - next1;
            else meet(next1, count1, object, here, along, left_face, left_object, hit);
            t1 = FAR;
        }
        if (t0 < FAR && t1 < FAR) {
            stack[waiting++] = t0 <= t1 ? next1 : next0;
            node = t0 <= t1 ? next0 : next1;
            continue;
        }
        if (t0 < FAR || t1 < FAR) {
            node = t0 < FAR ? next0 : next1;
            continue;
        }
        if (waiting == 0) break;
        node = stack[--waiting];
        if (node == -1) {  // The end of an object.
            object = -1, here = o, along = d, inverse = inverse_of(d);
            if (waiting == 0) break;
            node = stack[--waiting];
        }
        if (node < -1) {  // An object, whose ray is followed in the object's own space.
            object = -2 - node;
            vec4 x = of_object(object, TURN), y = of_object(object, TURN + 1), z = of_object(object, TURN + 2);
            mat3 turn = mat3(x.xyz, y.xyz, z.xyz);  // The transpose of world_from_object, as columns are written.
            here = turn * (o - vec3(x.w, y.w, z.w)), along = turn * d, inverse = inverse_of(along);
            stack[waiting++] = -1;
            node = int(of_object(object, TREE).x);
        }
    }
    return hit;
}

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

vec4 medium(int rank) { return rank < 0 ? vec4(1.0, 0.0, 0.0, 0.0) : of_object(rank, MEDIUM); }

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
    float turn = n.z < 0.0 ? -1.0 : 1.0, a = -1.0 / (turn + n.z), b = n.x * n.y * a;
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

// ---- Networks

vec4 leaky(vec4 x) { return max(x, 0.2 * x); }
vec3 softplus(vec3 x) { return max(x, 0.0) + log(1.0 + exp(-abs(x))); }

// Four outputs of a layer whose inputs come in fours.
vec4 four(int at, vec4 x) {
    return fetch(weights, at) * x.x + fetch(weights, at + 1) * x.y + fetch(weights, at + 2) * x.z
        + fetch(weights, at + 3) * x.w;
}

struct Features {
    vec4 values[FEATURE_TEXELS];
};

// Bilinear look-ups in all levels of an object's texture.
Features look_up(int object, vec2 uv) {
    Features found;
    for (int k = 0; k < FEATURE_TEXELS; k++) found.values[k] = vec4(0.0);
    for (int level = 0; level < LEVELS; level++) {
        vec4 where = of_object(object, TEXTURE + level);
        int base = int(where.x), width = int(where.y);
        vec2 at = clamp(vec2(uv.x, 1.0 - uv.y) * float(width) - 0.5, 0.0, float(width - 1));
        ivec2 low = ivec2(at), high = min(low + 1, width - 1);
        at -= vec2(low);
        for (int k = 0; k < FEATURE_TEXELS; k++) {
            vec4 a = fetch(texels, (base + low.y * width + low.x) * FEATURE_TEXELS + k);
            vec4 b = fetch(texels, (base + low.y * width + high.x) * FEATURE_TEXELS + k);
            vec4 c = fetch(texels, (base + high.y * width + low.x) * FEATURE_TEXELS + k);
            vec4 e = fetch(texels, (base + high.y * width + high.x) * FEATURE_TEXELS + k);
            found.values[k] += mix(mix(a, b, at.x), mix(c, e, at.x), at.y);
        }
    }
    return found;
}

#if COMPOSITE == 1
// Linear radiance that leaves the end of a branch. Inputs after the features: cosine, harmonics, octaves.
vec3 decode(Features features, float cosine, vec3 reflected, vec3 p) {
    float others[INPUTS - 4 * FEATURE_TEXELS];
    others[0] = cosine;
#if SEES_DIRECTIONS == 1
    vec3 r = reflected;
    others[1] = 0.28209479177387814, others[2] = 0.4886025119029199 * r.y, others[3] = 0.4886025119029199 * r.z;
    others[4] = 0.4886025119029199 * r.x, others[5] = 1.0925484305920792 * r.x * r.y;
    others[6] = 1.0925484305920792 * r.y * r.z, others[7] = 0.31539156525252005 * (3.0 * r.z * r.z - 1.0);
    others[8] = 1.0925484305920792 * r.x * r.z, others[9] = 0.5462742152960396 * (r.x * r.x - r.y * r.y);
#endif
    for (int octave = 0; octave < OCTAVES; octave++) {
        vec3 angle = p * (3.141592653589793 * float(1 << octave));
        int at = 1 + 9 * SEES_DIRECTIONS + 6 * octave;
        others[at] = sin(angle.x), others[at + 1] = sin(angle.y), others[at + 2] = sin(angle.z);
        others[at + 3] = cos(angle.x), others[at + 4] = cos(angle.y), others[at + 5] = cos(angle.z);
    }
    vec4 hidden[GROUPS];
    for (int g = 0; g < GROUPS; g++) {
        vec4 sum = fetch(weights, FIRST_BIAS + g);
        int at = FIRST + g * INPUTS;
        for (int k = 0; k < FEATURE_TEXELS; k++) sum += four(at + 4 * k, features.values[k]);
        at += 4 * FEATURE_TEXELS;
        for (int k = 0; k < INPUTS - 4 * FEATURE_TEXELS; k++) sum += fetch(weights, at + k) * others[k];
        hidden[g] = leaky(sum);
    }
    vec4 color = fetch(weights, THIRD_BIAS);
    for (int g = 0; g < GROUPS; g++) {
        vec4 sum = fetch(weights, SECOND_BIAS + g);
        for (int k = 0; k < GROUPS; k++) sum += four(SECOND + g * HIDDEN + 4 * k, hidden[k]);
        color += four(THIRD + 4 * g, leaky(sum));
    }
    return softplus(color.rgb + features.values[0].rgb);
}

// Radiance from outside of the scene.
vec3 sky(vec3 d) {
    float azimuth = atan(d.y, d.x) / 3.141592653589793, polar = 2.0 * acos(clamp(d.z, -1.0, 1.0)) / 3.141592653589793 - 1.0;
    vec3 sum = vec3(0.0);
    int base = SKY;
    for (int level = 0; level < SKY_LEVELS; level++) {
        bool last = level == SKY_LEVELS - 1;
        int height = last ? 1 : SKY_HEIGHT >> level, width = last ? 1 : 2 * SKY_HEIGHT >> level;
        float x = 0.5 * (azimuth + 1.0) * float(width) - 0.5;
        float y = clamp(0.5 * (polar + 1.0) * float(height) - 0.5, 0.0, float(height - 1));
        int left = int(floor(x)), top = int(y), below = min(top + 1, height - 1);
        float right_share = x - float(left), below_share = y - float(top);
        int right = (left + 1) % width;
        left = (left + width) % width;
        vec3 upper = mix(fetch(weights, base + top * width + left).rgb, fetch(weights, base + top * width + right).rgb, right_share);
        vec3 lower = mix(fetch(weights, base + below * width + left).rgb, fetch(weights, base + below * width + right).rgb, right_share);
        sum += mix(upper, lower, below_share);
        base += width * height;
    }
    vec3 light = softplus(sum);
    for (int lobe = 0; lobe < LOBES; lobe++) {
        vec4 axis = fetch(weights, base + 2 * lobe);
        light += exp(axis.w * (dot(d, axis.xyz) - 1.0)) * fetch(weights, base + 2 * lobe + 1).rgb;
    }
    return light;
}
#endif

// ---- Paths

// A branch that waits to be followed.
struct Start {
    float weight;
    vec3 o, d, beta;
    int face, object;
    uint solids;
};

vec3 unfold(vec2 code) {
    float z = 1.0 - abs(code.x) - abs(code.y), back = max(-z, 0.0);
    return normalize(vec3(code.x >= 0.0 ? code.x - back : code.x + back, code.y >= 0.0 ? code.y - back : code.y + back, z));
}

vec3 trace(vec3 o, vec3 d, vec2 row, uint ray) {
    vec3 radiance = vec3(0.0), beta = vec3(1.0);
#if STACK_HIDDEN > 0
    vec4 stacked[STACK_GROUPS];
    for (int g = 0; g < STACK_GROUPS; g++) stacked[g] = fetch(weights, S_FIRST_BIAS + g);
#endif
    Start queue[BRANCHES > 1 ? BRANCHES - 1 : 1];
    for (int i = 0; i < BRANCHES - 1; i++) queue[i].weight = 0.0;
    uint solids = NO_SOLIDS;
    int left_face = NO_FACE, left_object = 0, branch = 0, vertex = 0;

    for (int step = 0; step < BRANCHES * MAX_DEPTH + SPARE_STEPS; step++) {
        Hit hit = find(o, d, left_face, left_object);
        bool missed = hit.face == NO_FACE, is_over = missed;
        if (missed) {
#if COMPOSITE == 1
            radiance += beta * sky(d);
#endif
        } else {
            // Where the ray is, and what is there.
            vec4 x = of_object(hit.object, TURN), y = of_object(hit.object, TURN + 1), z = of_object(hit.object, TURN + 2);
            mat3 turn = transpose(mat3(x.xyz, y.xyz, z.xyz));
            vec4 c0 = fetch(triangles, 3 * hit.face), c1 = fetch(triangles, 3 * hit.face + 1), c2 = fetch(triangles, 3 * hit.face + 2);
            vec4 a0 = fetch(vertices, int(c0.w)), a1 = fetch(vertices, int(c1.w)), a2 = fetch(vertices, int(c2.w));
            vec3 share = vec3(1.0 - hit.b.x - hit.b.y, hit.b);
            vec3 p = turn * (c0.xyz * share.x + c1.xyz * share.y + c2.xyz * share.z) + vec3(x.w, y.w, z.w);
            vec3 n = turn * normalize(unfold(a0.xy) * share.x + unfold(a1.xy) * share.y + unfold(a2.xy) * share.z);
            vec3 n_face = turn * normalize(cross(c1.xyz - c0.xyz, c2.xyz - c0.xyz));
            vec2 uv = a0.zw * share.x + a1.zw * share.y + a2.zw * share.z;
            vec4 optics = of_object(hit.object, OPTICS), color = of_object(hit.object, COLOR);
            int kind = int(optics.x), rank = int(optics.w);

            // The medium on the way here, and those on both sides of the surface.
            bool is_outside = dot(d, n_face) < 0.0, is_glass = kind == DIELECTRIC, is_thin = kind == THIN;
            int medium_here = medium_of(solids);
            uint beyond = solids, here = solids;
            if (is_glass) {
                uint inside = with_solid(solids, rank), outside = without_solid(solids, rank);
                beyond = is_outside ? inside : outside;
                here = is_outside ? outside : inside;
            }
            // Where a solid of higher priority fills both sides, there is no surface.
            bool is_void = is_glass && medium_of(here) == medium_of(beyond);
            if (medium_here >= 0) beta *= exp(-medium(medium_here).yzw * length(p - o));

            vec3 facing = is_outside ? n : -n, outward = is_outside ? n_face : -n_face;
            float cos_i = clamp(-dot(d, facing), 0.0, 1.0), offset = OFFSET * (1.0 + max(abs(p.x), max(abs(p.y), abs(p.z))));
            bool is_end = kind == OPAQUE || kind == COATED || kind == METAL;
            bool is_stacked = STACK_HIDDEN > 0 && !is_void && (branch == 0 && vertex < 4 || branch == 1 && vertex < 2);
            if (is_stacked || is_end && COMPOSITE == 1) {
                Features features = look_up(hit.object, uv);
#if STACK_HIDDEN > 0
                if (is_stacked) {
                    int slot = (branch == 0 ? vertex : 4 + vertex) * SLOT;
                    float through = (beta.r + beta.g + beta.b) / 3.0;
                    for (int g = 0; g < STACK_GROUPS; g++) {
                        int at = S_FIRST + g * 6 * SLOT + slot;
                        for (int k = 0; k < FEATURE_TEXELS; k++) stacked[g] += four(at + 4 * k, features.values[k]);
                        at += 4 * FEATURE_TEXELS;
                        stacked[g] += fetch(weights, at) * through + fetch(weights, at + 1) * cos_i;
                    }
                }
#endif
#if COMPOSITE == 1
                if (is_end) radiance += beta * decode(features, cos_i, d + 2.0 * cos_i * facing, p);
#endif
            }

            // What the surface does to the ray.
            bool borders = is_glass && !is_void;
            float eta = borders ? medium(medium_of(beyond)).x / medium(medium_of(here)).x : optics.y;
            vec2 f = fresnel(cos_i, eta);
            float reflectance = is_thin ? 2.0 * f.x / (1.0 + f.x) : f.x;
            bool total = borders && f.x >= 1.0;
            vec3 mirrored = normalize(d + 2.0 * cos_i * facing), m_beta = beta * reflectance, next_d = d;
            if (total) next_d = mirrored;
            else if (borders) next_d = normalize(d / eta + facing * (cos_i / eta - f.y));
            vec3 next_share = vec3(total ? 1.0 : (1.0 - reflectance) * (is_glass ? 1.0 / (eta * eta) : 1.0));
            if (is_thin) next_share *= color.rgb;
            bool is_rough = ROUGH_GLASS == 1 && borders && optics.z > 0.0;
            if (kind == COATED || kind == METAL || is_rough) {
                Facet facet = facet_towards(d, facing, optics.z, random_point(row, ray, step));
                vec2 at_facet = fresnel(facet.cosine, eta);
                float shadowing, passed;
                mirrored = mirrored_by(facet, shadowing);
                m_beta = beta * shadowing * (kind == METAL ? color.rgb : vec3(at_facet.x));
                if (is_rough) {
                    total = at_facet.x >= 1.0;
                    vec3 refracted = refracted_by(facet, at_facet.y, eta, passed);
                    next_d = total ? mirrored : refracted;
                    next_share = vec3(total ? shadowing : (1.0 - at_facet.x) * passed / (eta * eta));
                }
            }

            // A further branch, where light also comes by reflection. Of a full queue the weakest one falls out.
            float weight = max(m_beta.r, max(m_beta.g, m_beta.b));
            if (BRANCHES > 1 && !is_void && kind != OPAQUE && !total && weight > MIN_THROUGHPUT) {
                if (branch == 0 && vertex == 0) weight = FIRST_MIRROR;
                int weakest = 0;
                for (int i = 1; i < BRANCHES - 1; i++) if (queue[i].weight < queue[weakest].weight) weakest = i;
                if (weight > queue[weakest].weight)
                    queue[weakest] = Start(weight, p + outward * offset, mirrored, m_beta, hit.face, hit.object, solids);
            }

            // The next segment of this branch.
            bool passes = is_thin || is_glass, goes_through = passes && !total;
            if (passes && !is_void) beta *= next_share;
            if (passes) {
                o = p + (goes_through ? -outward : outward) * offset;
                d = next_d;
            }
            if (goes_through) solids = beyond;
            left_face = hit.face, left_object = hit.object;
            if (!is_void) vertex++;
            is_over = !passes || !is_void && vertex == MAX_DEPTH;
            // A facet's refracted ray that does not come out on the other side is lost.
            if (ROUGH_GLASS == 1 && !is_void && beta == vec3(0.0)) is_over = true;
        }

        // The end of this branch: the next one, or none.
        if (is_over) {
            if (branch + 1 >= BRANCHES) break;
            int best = 0;
            for (int i = 1; i < BRANCHES - 1; i++) if (queue[i].weight > queue[best].weight) best = i;
            if (queue[best].weight <= 0.0) break;
            o = queue[best].o, d = queue[best].d, beta = queue[best].beta;
            left_face = queue[best].face, left_object = queue[best].object, solids = queue[best].solids;
            queue[best].weight = 0.0;
            branch++, vertex = 0;
        }
    }
#if STACK_HIDDEN > 0
    // What physics leaves out.
    vec4 residual = fetch(weights, S_THIRD_BIAS);
    for (int g = 0; g < STACK_GROUPS; g++) {
        vec4 sum = fetch(weights, S_SECOND_BIAS + g);
        for (int k = 0; k < STACK_GROUPS; k++) sum += four(S_SECOND + g * STACK_HIDDEN + 4 * k, leaky(stacked[k]));
        residual += four(S_THIRD + 4 * g, leaky(sum));
    }
    radiance += softplus(residual.rgb - (COMPOSITE == 1 ? 4.0 : 1.0));
#endif
    return radiance;
}

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.x, size.y - gl_FragCoord.y);  // From the upper left.
    vec2 at = vec2(pixel) + place - 0.5 * size;
    vec3 d = normalize(camera_turn * vec3(at.x / focal, -at.y / focal, -1.0));
    if (task == 1) {
        Hit hit = find(camera_place, d, NO_FACE, 0);
        result = vec4(hit.face == NO_FACE ? -1.0 : float(hit.object), hit.t, 0.0, 1.0);
        return;
    }
    uint ray = (uint(pixel.y) * uint(size.x) + uint(pixel.x)) % chunk * samples + ray_sample;
    // The R2 sequence in whole numbers: its step is 2^32 over the plastic number, and over its square.
    vec2 row = vec2(float(ray * 3242174889u), float(ray * 2447445414u)) * 2.3283064365386963e-10;
    vec3 radiance = trace(camera_place, d, row, ray);
    result = vec4(radiance, 1.0) + keep * texelFetch(before, ivec2(gl_FragCoord.xy), 0);
}

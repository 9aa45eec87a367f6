// Which surface a ray meets: the tables of the scene, and the way through the trees over it. The numbers
// in capitals that no shader declares are those of model/web/scene.py and of the method's page.

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
uniform vec2 in_pixel;     // Of the ray in its pixel: right and down from the upper left corner.
uniform uint chunk;        // Pixels that share out the facets of rough surfaces among them.
uniform uint samples;      // Rays of each pixel that do.
uniform uint ray_sample;   // Which of these this frame is.
uniform uint seed;         // Of the facets.
uniform float keep;        // 1: add to the frames before; 0: begin.
uniform int task;          // PICTURE; or of one ray, for each pixel one answer: LAYERS, PATH.

out vec4 result;

const int PICTURE = 0, LAYERS = 1, PATH = 2;  // Tasks.
const float FAR = 1e30;
const int NO_FACE = -1;

vec4 fetch(highp sampler2D table, int index) {
    return texelFetch(table, ivec2(index % TEXTURE_WIDTH, index / TEXTURE_WIDTH), 0);
}

vec4 of_object(int object, int column) { return texelFetch(objects, ivec2(column, object), 0); }

// Columns of `objects`: rows of world_from_object and its shift, what the surface does, its colour and where its texels
// of metal begin, the root of the object's tree, how many times as large as its mesh it is, columns and rows of the
// texels of metal; by rank the medium's indices, whether they differ, and its absorption; then the places of the
// object's texels.
const int TURN = 0, OPTICS = 3, COLOR = 4, TREE = 5, MEDIUM = 6, TEXTURE = 8;

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

// The nearest face of the objects in the tree at a root, but for the one that the ray leaves.
Hit find(int root, vec3 o, vec3 d, int left_face, int left_object) {
    Hit hit = Hit(FAR, vec2(0.0), NO_FACE, 0);
    int stack[STACK];
    int waiting = 0, node = root, object = -1;
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
            vec4 tree = of_object(object, TREE);
            float shrink = 1.0 / (tree.y * tree.y);  // The rows are as long as the object is large.
            here = turn * (o - vec3(x.w, y.w, z.w)) * shrink, along = turn * d * shrink, inverse = inverse_of(along);
            stack[waiting++] = -1;
            node = int(tree.x);
        }
    }
    return hit;
}

// A place on a surface, as a ray in direction d finds it.
struct Place {
    vec3 p, facing, outward;  // Shading normal and face's normal on the side from which the ray comes.
    vec2 uv, uv_slope;        // Of the slope: for every metre of depth below the surface.
    float cosine, offset;     // Between ray and shading normal; how far from here a new ray starts.
    bool is_outside;
};

#if NORMALS == 1
vec3 unfold(vec2 code) {
    float z = 1.0 - abs(code.x) - abs(code.y), back = max(-z, 0.0);
    return normalize(vec3(code.x >= 0.0 ? code.x - back : code.x + back, code.y >= 0.0 ? code.y - back : code.y + back, z));
}
#endif

Place place_of(Hit hit, vec3 d) {
    vec4 x = of_object(hit.object, TURN), y = of_object(hit.object, TURN + 1), z = of_object(hit.object, TURN + 2);
    mat3 turn = transpose(mat3(x.xyz, y.xyz, z.xyz));
    vec4 c0 = fetch(triangles, 3 * hit.face), c1 = fetch(triangles, 3 * hit.face + 1), c2 = fetch(triangles, 3 * hit.face + 2);
    vec4 a0 = fetch(vertices, int(c0.w)), a1 = fetch(vertices, int(c1.w)), a2 = fetch(vertices, int(c2.w));
    vec3 share = vec3(1.0 - hit.b.x - hit.b.y, hit.b);
    Place place;
    place.p = turn * (c0.xyz * share.x + c1.xyz * share.y + c2.xyz * share.z) + vec3(x.w, y.w, z.w);
    place.uv = a0.zw * share.x + a1.zw * share.y + a2.zw * share.z;
    vec3 n_face = normalize(turn * normalize(cross(c1.xyz - c0.xyz, c2.xyz - c0.xyz)));
    place.is_outside = dot(d, n_face) < 0.0;
    place.outward = place.is_outside ? n_face : -n_face;
#if NORMALS == 1
    vec3 n = turn * normalize(unfold(a0.xy) * share.x + unfold(a1.xy) * share.y + unfold(a2.xy) * share.z);
    n /= of_object(hit.object, TREE).y;
    place.facing = place.is_outside ? n : -n;
#else
    place.facing = place.outward;
#endif
    place.cosine = clamp(-dot(d, place.facing), 0.0, 1.0);
    vec3 reach = max(abs(c0.xyz), max(abs(c1.xyz), abs(c2.xyz))) + abs(vec3(x.w, y.w, z.w));
    place.offset = RAY_OFFSET * max(reach.x, max(reach.y, reach.z));
#if RELIEF == 1
    // The ray goes on in the plane of the face, whose edges are e1 and e2: d = a e1 + b e2 + c n.
    vec3 e1 = turn * (c1.xyz - c0.xyz), e2 = turn * (c2.xyz - c0.xyz), n_wide = cross(e1, e2);
    float square = dot(n_wide, n_wide), per_depth = 1.0 / max(square * max(abs(dot(d, n_face)), MIN_COSINE), 1e-30);
    vec2 along = dot(cross(d, e2), n_wide) * (a1.zw - a0.zw) + dot(cross(e1, d), n_wide) * (a2.zw - a0.zw);
    place.uv_slope = along * (place.is_outside ? per_depth : -per_depth);
#endif
    return place;
}

// The way through a wall that a ray skips which starts off its other face. Source: datagen/scene/media.py.
float skipped_length(Place place, vec3 d) { return place.offset / max(abs(dot(d, place.outward)), SKIP_COSINE); }

// A ray that goes straight on through all that it meets.
struct Walk {
    vec3 o;
    int face, object;
};

Hit next_of(inout Walk walk, int root, vec3 d, out Place place) {
    Hit hit = find(root, walk.o, d, walk.face, walk.object);
    if (hit.face == NO_FACE) return hit;
    place = place_of(hit, d);
    walk = Walk(place.p - place.outward * place.offset, hit.face, hit.object);
    return hit;
}

// The light paths of a ray, and what physics says that they bring. Source: datagen/trace/branches.py.

const int QUEUE = BRANCHES > 2 ? BRANCHES - 1 : 1;

int asked;    // Of the task PATH: which end of which segment,
vec4 answer;  // and where that is.

bool parted;      // Glass that parts colours is on the way.
bool stacks;  // Whether the stack network is told of the first vertices.

// A branch that waits to be followed.
struct Start {
    float weight;
    vec3 o, d, beta;
    int face, object;
    uint solids;
};

// Linear radiance of a ray; the stack network's first layer sums up what it meets.
vec3 trace(vec3 o, vec3 d, vec2 row, uint ray) {
    vec3 radiance = vec3(0.0), beta = vec3(1.0);
    Start queue[QUEUE];
    for (int i = 0; i < QUEUE; i++) queue[i].weight = 0.0;
    uint solids = NO_SOLIDS;
    int left_face = NO_FACE, left_object = 0, branch = 0, vertex = 0;

    for (int step = 0; step < BRANCHES * MAX_DEPTH + SPARE_STEPS; step++) {
        Hit hit = find(OBJECTS_ROOT, o, d, left_face, left_object);
        bool missed = hit.face == NO_FACE, is_over = missed;
        if (task == PATH && step == asked / 2 && asked % 2 == 0) {
            answer = vec4(o, float(branch) + 0.5 * min(max(beta.r, max(beta.g, beta.b)), 1.0));
            return radiance;
        }
        if (task == PATH && step == asked / 2) {
            answer = vec4(o + d * (missed ? 1.0 : hit.t), missed ? -1.0 : float(hit.object));
            return radiance;
        }
        if (missed) {
            radiance += beta * sky(d);
        } else {
            // Where the ray is, and what is there.
            Place place = place_of(hit, d);
            vec3 p = place.p, facing = place.facing, outward = place.outward;
            vec4 optics = of_object(hit.object, OPTICS), color = of_object(hit.object, COLOR);
            int kind = int(optics.x), rank = int(optics.w);

            // The medium on the way here, and those on both sides of the surface.
            bool is_outside = place.is_outside, is_glass = kind == REFRACTS, is_thin = kind == PASSES;
            int medium_here = medium_of(solids);
            uint beyond = solids, here = solids;
            if (is_glass) {
                uint inside = with_solid(solids, rank), outside = without_solid(solids, rank);
                beyond = is_outside ? inside : outside;
                here = is_outside ? outside : inside;
            }
            // Where a solid of higher priority fills both sides, there is no surface.
            bool is_void = is_glass && medium_of(here) == medium_of(beyond);
            if (medium_here >= 0) beta *= exp(-absorption_of(medium_here) * (length(p - o) + skipped_length(place, d)));

            float cos_i = place.cosine, offset = place.offset;
            bool is_end = kind == ENDS || kind == COATED || kind == MIRRORS;
            bool is_stacked = STACK_HIDDEN > 0 && !is_void && (branch == 0 && vertex < STACKED_FIRST || branch == 1 && vertex < STACKED_SECOND);
            if (is_stacked || is_end) {
                Features features = look_up(hit.object, place.uv);
#if STACK_HIDDEN > 0
                if (is_stacked && stacks) stack_slot(branch == 0 ? vertex : STACKED_FIRST + vertex, features, (beta.r + beta.g + beta.b) / 3.0, cos_i);
#endif
#if RELIEF == 1
                if (is_end) features = look_up(hit.object, relieved(hit.object, place));
#endif
                if (is_end) radiance += beta * decode(features, cos_i, d + 2.0 * cos_i * facing);
            }

            // What the surface does to the ray.
            bool borders = is_glass && !is_void;
            float eta = borders ? index_of(medium_of(beyond)) / index_of(medium_of(here)) : optics.y;
            if (borders && (parts_colors(medium_of(beyond)) || parts_colors(medium_of(here)))) parted = true;
            vec2 f = fresnel(cos_i, eta);
            float reflectance = is_thin ? 2.0 * f.x / (1.0 + f.x) : f.x;
            bool total = borders && f.x >= 1.0;
            vec3 mirrored = normalize(d + 2.0 * cos_i * facing), m_beta = beta * reflectance, next_d = d;
            if (total) next_d = mirrored;
            else if (borders) next_d = normalize(d / eta + facing * (cos_i / eta - f.y));
            vec3 next_share = vec3(total ? 1.0 : (1.0 - reflectance) * (is_glass ? 1.0 / (eta * eta) : 1.0));
            // Between overlapping parts of one glass there is no surface that could tint.
            vec3 tint = is_thin || borders && abs(eta - 1.0) > SAME_INDEX ? color.rgb : vec3(1.0);
            if (!total) next_share *= tint;
            bool is_rough = ROUGH_GLASS == 1 && borders && optics.z > 0.0;
            if (kind == COATED || kind == MIRRORS || is_rough) {
                Facet facet = facet_towards(d, facing, optics.z, random_point(row, ray, step));
                vec2 at_facet = fresnel(facet.cosine, eta);
                float shadowing, passed;
                mirrored = mirrored_by(facet, shadowing);
                // Light that goes from facet to facet makes the lobes brighter; metal tints it at each.
                vec3 metal = kind == MIRRORS ? metal_color(hit.object, place.uv) : vec3(1.0);
                vec3 gain = 1.0 / (1.0 - metal * (1.0 - albedo(cos_i, optics.z, eta)));
                m_beta = beta * gain * shadowing * (kind == MIRRORS ? metal : vec3(at_facet.x));
                if (is_rough) {
                    total = at_facet.x >= 1.0;
                    vec3 refracted = refracted_by(facet, at_facet.y, eta, passed);
                    next_d = total ? mirrored : refracted;
                    next_share = gain * (total ? vec3(shadowing) : tint * ((1.0 - at_facet.x) * passed / (eta * eta)));
                }
            }

            // A further branch, where light also comes by reflection. Of a full queue the weakest one falls out.
            float weight = max(m_beta.r, max(m_beta.g, m_beta.b));
            if (BRANCHES > 1 && !is_void && kind != ENDS && !total && weight > MIN_THROUGHPUT) {
                if (branch == 0 && vertex == 0) weight = FIRST_MIRROR;
                int weakest = 0;
                for (int i = 1; i < QUEUE; i++) if (queue[i].weight < queue[weakest].weight) weakest = i;
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
            for (int i = 1; i < QUEUE; i++) if (queue[i].weight > queue[best].weight) best = i;
            if (queue[best].weight <= 0.0) break;
            o = queue[best].o, d = queue[best].d, beta = queue[best].beta;
            left_face = queue[best].face, left_object = queue[best].object, solids = queue[best].solids;
            queue[best].weight = 0.0;
            branch++, vertex = 0;
        }
    }
    return radiance;
}

// The same of all colours, which go ways of their own through glass that parts them.
vec3 trace_colors(vec3 o, vec3 d, vec2 row, uint ray) {
    vec3 radiance;
    // Green, or all colours at once; red; blue. The call stands here once, for it takes long to compile.
    for (int turn = 0; turn < (DISPERSES == 1 ? 3 : 1); turn++) {
        if (turn > 0 && !parted) continue;
        channel = turn == 1 ? 0 : turn == 2 ? 2 : 1;
        stacks = turn == 0;
        if (turn == 0) parted = false;
#if STACK_HIDDEN > 0
        if (stacks) begin_stack();
#endif
        vec3 found = trace(o, d, row, ray);
        if (turn == 0) radiance = found;
        else radiance[channel] = found[channel];
        if (task == PATH) break;
    }
    channel = 1;
    return radiance;
}

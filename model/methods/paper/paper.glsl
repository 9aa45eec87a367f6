// The paper's renderer: all layers of the straight ray, stacked into the network of its pixel.
// Source: model/methods/paper/renderer.py, model/nets/pixel_mlp.py.

const int TOLD = 4 * FEATURE_TEXELS + EXTRINSICS, INPUTS = LAYERS_SEEN * TOLD, GROUPS = (WIDTH + 3) / 4;

vec4 x[GROUPS], y[GROUPS], z[GROUPS];
int weights_at;  // Where the next layer's weights begin.

// The layer's sums for four outputs, of inputs that come in fours.
#define LAYER(from, ins, to, outs) \
    for (int g = 0; g < outs; g++) { \
        vec4 sum = fetch(weights, weights_at + outs * 4 * ins + g); \
        for (int k = 0; k < ins; k++) sum += four(weights_at + 4 * (g * ins + k), from[k]); \
        to[g] = sum; \
    } \
    weights_at += outs * (4 * ins + 1);

// What the first layer makes of a surface: its features, and what it is told of the camera.
void stack_layer(int layer, Features features, vec3 view) {
#if EXTRINSICS == 9
    float told[9] = harmonics(view);
#else
    float told[3] = float[3](view.x, view.y, view.z);
#endif
    for (int g = 0; g < GROUPS; g++) {
        int from = g * INPUTS + layer * TOLD;
        for (int k = 0; k < FEATURE_TEXELS; k++) x[g] += four(from + 4 * k, features.values[k]);
        for (int k = 0; k < EXTRINSICS; k++) x[g] += fetch(weights, from + 4 * FEATURE_TEXELS + k) * told[k];
    }
}

// Linear radiance of a ray.
vec3 shade(vec3 o, vec3 d, vec2 row, uint ray) {
    weights_at = GROUPS * INPUTS;
    for (int g = 0; g < GROUPS; g++) x[g] = fetch(weights, weights_at + g);
    weights_at += GROUPS;
    Walk walk = Walk(o, NO_FACE, 0);
    for (int layer = 0; layer < LAYERS_SEEN; layer++) {
        Place place;
        Hit hit = next_of(walk, OBJECTS_ROOT, d, place);
        if (hit.face == NO_FACE) break;
        stack_layer(layer, look_up(hit.object, place.uv), normalize(o - place.p));
    }
    for (int g = 0; g < GROUPS; g++) x[g] = leaky(x[g]);
    for (int block = 0; block < BLOCKS; block++) {
        int wide = ((WIDTH >> block) + 3) / 4, narrow = ((WIDTH >> (block + 1)) + 3) / 4;
        LAYER(x, wide, y, wide)
        for (int g = 0; g < wide; g++) y[g] = leaky(y[g]);
        LAYER(y, wide, z, wide)
        for (int g = 0; g < wide; g++) x[g] += leaky(z[g]);
        LAYER(x, wide, y, narrow)
        for (int g = 0; g < narrow; g++) x[g] = leaky(y[g]);
    }
    int last = ((WIDTH >> BLOCKS) + 3) / 4;
    LAYER(x, last, y, 1)
    return linear_of(y[0].rgb);
}

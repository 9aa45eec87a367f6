// What stands beside the light paths: the straight layers of runs on proxies, and the network that sees all vertices.
// Source: model/methods/light_path/net.py.

#if STRAIGHT > 0
// A straight layer, as the networks see it.
struct Layer {
    Features features;
    float cosine;
    vec3 reflected;
};

Layer layers[STRAIGHT];
int num_layers = 0;

void stack_straight(vec3 o, vec3 d) {
    Walk walk = Walk(o, NO_FACE, 0);
    for (num_layers = 0; num_layers < STRAIGHT; num_layers++) {
        Place place;
        Hit hit = next_of(walk, SHELLS_ROOT, d, place);
        if (hit.face == NO_FACE) break;
        Features features = look_up(hit.object, relieved(hit.object, place));
        layers[num_layers] = Layer(features, place.cosine, d + 2.0 * place.cosine * place.facing);
        stack_slot(PATH_SLOTS + num_layers, features, 1.0, place.cosine);
    }
    for (int g = 0; g < STACK_GROUPS; g++) {
        int at = S_FIRST + g * STACK_INPUTS + SLOTS * SLOT;
        stacked[g] += four(at, vec4(d, 0.0));
    }
}

// The layers, each laid over those behind it, and the sky behind all; what the stack says of their opacity comes in
// fours.
vec3 lay_over(vec3 d, vec4 logits[STACK_OUTPUTS]) {
    vec3 sum = vec3(0.0);
    float passed = 1.0, bands[9] = harmonics(d);
    for (int k = 0; k < num_layers; k++) {
        // A layer's opacity also depends on its own features.
        float own = network(COVER, 10, layers[k].features, layers[k].cosine, bands).x;
        float opacity = sigmoid(logits[1 + k / 4][k % 4] + own);
        sum += passed * opacity * decode(layers[k].features, layers[k].cosine, layers[k].reflected);
        passed *= 1.0 - opacity;
    }
    return sum + passed * sky(d);
}
#endif

// Linear radiance of a ray.
vec3 shade(vec3 o, vec3 d, vec2 row, uint ray) {
    vec3 radiance = trace_colors(o, d, row, ray);
#if STACK_HIDDEN > 0
#if STRAIGHT > 0
    stack_straight(o, d);
#endif
    vec4 said[STACK_OUTPUTS], hidden[STACK_GROUPS];
    for (int g = 0; g < STACK_GROUPS; g++) {
        vec4 sum = fetch(weights, S_SECOND_BIAS + g);
        for (int k = 0; k < STACK_GROUPS; k++) sum += four(S_SECOND + g * STACK_HIDDEN + 4 * k, leaky(stacked[k]));
        hidden[g] = leaky(sum);
    }
    for (int out_group = 0; out_group < STACK_OUTPUTS; out_group++) {
        said[out_group] = fetch(weights, S_THIRD_BIAS + out_group);
        for (int g = 0; g < STACK_GROUPS; g++) said[out_group] += four(S_THIRD + out_group * STACK_HIDDEN + 4 * g, hidden[g]);
    }
#if STRAIGHT > 0
    radiance = mix(lay_over(d, said), radiance, sigmoid(said[0].w));
#endif
    // What physics leaves out.
    radiance += softplus(said[0].rgb - STACK_SHIFT);
#endif
    return radiance;
}

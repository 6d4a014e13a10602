/* The C interface, from C: a pair with a known answer, what is wrong in words, every option and field felt. */

#include <mgca/mgca.h>

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { COUNT = 200, RIGHT = 140 };

static int failures = 0;

static void check(int holds, const char *what) {
    if (!holds) {
        ++failures;
        fprintf(stderr, "FAILED: %s (%s)\n", what, mgca_last_error());
    }
}

static void fails(int code, int expected, const char *words) {
    if (code != expected || strstr(mgca_last_error(), words) == NULL) {
        ++failures;
        fprintf(stderr, "FAILED: code %d and '%s' expected, got %d and '%s'\n", expected, words, code, mgca_last_error());
    }
}

static uint32_t state = 1;

static double uniform(double low, double high) {
    state = state * 1664525u + 1013904223u;
    return low + (high - low) * (double)(state >> 8) / 16777216.0;
}

static const double K[9] = {800.0, 0.0, 319.5, 0.0, 800.0, 239.5, 0.0, 0.0, 1.0};
static double points1[2 * COUNT], points2[2 * COUNT];
static float ratio[COUNT];

/* The camera moves to the right, along the x axis; the last matches are wrong. */
static void make_pair(void) {
    for (int i = 0; i < COUNT; ++i) {
        points1[2 * i] = uniform(0.0, 640.0);
        points1[2 * i + 1] = uniform(0.0, 480.0);
        points2[2 * i] = i < RIGHT ? points1[2 * i] - 800.0 / uniform(4.0, 11.0) : uniform(0.0, 640.0);
        points2[2 * i + 1] = i < RIGHT ? points1[2 * i + 1] : uniform(0.0, 480.0);
        ratio[i] = (float)(i < RIGHT ? uniform(0.3, 0.8) : uniform(0.7, 1.0));
    }
}

static int num_kept(const mgca_result *result) { return (int)mgca_result_number(result, "num_inliers"); }

static void finds_the_pose(const mgca_filter *filter) {
    mgca_result *result = NULL;
    check(mgca_filter_points(filter, points1, points2, ratio, COUNT, K, NULL, &result) == MGCA_DONE, "a pair");
    check(mgca_result_status(result) == MGCA_OK && mgca_result_ok(result), "status");
    check(strcmp(mgca_status_word(mgca_result_status(result)), "ok") == 0, "word");
    check(mgca_result_size(result) == COUNT, "size");
    const unsigned char *mask = mgca_result_mask(result);
    int kept = 0, right = 0;
    for (int i = 0; i < COUNT; ++i) {
        kept += mask[i];
        right += i < RIGHT ? mask[i] : 0;
    }
    check(kept == num_kept(result) && right == RIGHT && kept < RIGHT + 10, "mask");
    const float *scores = mgca_result_scores(result), *logits = mgca_result_logits(result);
    check(scores[0] > 0.5f && scores[0] <= 1.0f && isfinite(logits[0]), "scores and logits");
    const double *t = mgca_result_translation(result), *R = mgca_result_matrix(result, "R");
    check(t != NULL && t[0] < -0.99, "translation");
    check(R != NULL && R[0] > 0.999 && R[4] > 0.999 && R[8] > 0.999, "rotation");
    check(mgca_result_matrix(result, "E") != NULL && mgca_result_matrix(result, "F") != NULL, "E and F");
    check(mgca_result_matrix(result, "H") == NULL, "no H");
    check(mgca_result_number(result, "confidence") > 0.5, "confidence");
    check(mgca_result_number(result, "num_accepted") > 0.8 * RIGHT, "num_accepted");
    check(isnan(mgca_result_number(result, "focal_px1")) && isnan(mgca_result_number(result, "focal_sigma2")),
          "no focal length is estimated");
    check(mgca_result_number(result, "mirrored") == 0.0, "no image is mirrored");
    check(strcmp(mgca_result_word(result, "intrinsics"), "given") == 0, "intrinsics");
    check(strlen(mgca_result_word(result, "origin")) > 0, "origin");
    check(strlen(mgca_result_word(result, "ended")) > 0, "ended");
    check(strstr(mgca_result_assumption(result, 0), "K") != NULL, "one camera is assumed");
    check(mgca_result_assumption(result, 1) == NULL, "and nothing else");
    check(mgca_result_matrix(result, "P") == NULL && strstr(mgca_last_error(), "'P'") != NULL, "no P");
    check(isnan(mgca_result_number(result, "luck")) && strstr(mgca_last_error(), "'luck'") != NULL, "no luck");
    check(mgca_result_word(result, "poem") == NULL && strstr(mgca_last_error(), "'poem'") != NULL, "no poem");
    mgca_result_free(result);

    check(mgca_filter_points(filter, points1, points2, NULL, COUNT, NULL, NULL, &result) == MGCA_DONE, "without K");
    check(strcmp(mgca_result_word(result, "intrinsics"), "given") != 0, "intrinsics are not given");
    check(mgca_result_assumption(result, 0) != NULL, "something is assumed");
    mgca_result_free(result);
    check(mgca_filter_points(filter, NULL, NULL, NULL, 0, NULL, NULL, &result) == MGCA_DONE, "nothing at all");
    check(mgca_result_status(result) == MGCA_TOO_FEW_MATCHES && !mgca_result_ok(result), "too few");
    check(mgca_result_size(result) == 0, "no entries");
    mgca_result_free(result);
}

static void options_are_felt(const mgca_model *model) {
    mgca_filter *filter = NULL;
    mgca_result *plain = NULL, *result = NULL;
    check(mgca_filter_create(model, &filter) == MGCA_DONE, "a filter");
    mgca_filter_points(filter, points1, points2, ratio, COUNT, K, NULL, &plain);
    check(mgca_filter_set_word(filter, "method", "magsac") == MGCA_DONE, "method");
    check(mgca_filter_set_word(filter, "effort", "full") == MGCA_DONE, "effort");
    mgca_filter_points(filter, points1, points2, ratio, COUNT, K, NULL, &result);
    check(mgca_result_number(result, "num_network_matches") > 0.0, "effort is felt");
    check(mgca_result_network(result, 0) != NULL && mgca_result_network(result, 1) != NULL &&
              strcmp(mgca_result_network(result, 0), mgca_result_network(result, 1)) != 0 &&
              mgca_result_network(result, 2) == NULL,
          "both networks are asked");
    check(strcmp(mgca_result_word(result, "origin"), "magsac") == 0, "method is felt");
    mgca_result_free(result);
    check(mgca_filter_set_number(filter, "threshold", 0.001) == MGCA_DONE, "threshold");
    check(mgca_filter_set_number(filter, "seed", 3.0) == MGCA_DONE, "seed");
    check(mgca_filter_set_number(filter, "max_iterations", 900.0) == MGCA_DONE, "max_iterations");
    check(mgca_filter_set_number(filter, "confidence", 0.99) == MGCA_DONE, "confidence");
    mgca_filter_points(filter, points1, points2, ratio, COUNT, K, NULL, &result);
    check(num_kept(result) <= num_kept(plain), "threshold is felt");
    mgca_result_free(result);
    check(mgca_filter_set_word(filter, "geometry", "homography") == MGCA_DONE, "geometry");
    mgca_filter_points(filter, points1, points2, ratio, COUNT, K, NULL, &result);
    check(mgca_result_matrix(result, "E") == NULL, "geometry is felt");
    mgca_result_free(result);
    check(mgca_filter_set_number(filter, "keep_precision", 0.9) == MGCA_DONE, "keep_precision");
    check(mgca_filter_set_word(filter, "method", "none") == MGCA_DONE, "none");
    mgca_filter_points(filter, points1, points2, ratio, COUNT, K, NULL, &result);
    check(num_kept(result) > 0 && mgca_result_matrix(result, "H") == NULL, "keep_precision is felt");
    mgca_result_free(result);

    fails(mgca_filter_set_number(filter, "threshold", -1.0), MGCA_ARGUMENT_ERROR, "threshold");
    fails(mgca_filter_set_number(filter, "seed", 0.5), MGCA_ARGUMENT_ERROR, "seed: expected an integer");
    fails(mgca_filter_set_number(filter, "seed", NAN), MGCA_ARGUMENT_ERROR, "seed: expected an integer");
    fails(mgca_filter_set_number(filter, "sharpness", 1.0), MGCA_ARGUMENT_ERROR, "'sharpness'");
    fails(mgca_filter_set_word(filter, "method", "best"), MGCA_ARGUMENT_ERROR, "got 'best'");
    fails(mgca_filter_set_word(filter, "mood", "good"), MGCA_ARGUMENT_ERROR, "'mood'");
    fails(mgca_filter_set_word(filter, NULL, "good"), MGCA_ARGUMENT_ERROR, "option: must not be NULL");
    fails(mgca_filter_set_number(NULL, "seed", 1.0), MGCA_ARGUMENT_ERROR, "filter: must not be NULL");
    mgca_result_free(plain);
    mgca_filter_free(filter);
}

static void pairs_are_read(const mgca_filter *filter) {
    mgca_pair *pair = NULL;
    mgca_result *result = NULL;
    float sizes[COUNT], angles[COUNT], best[COUNT];
    double distances[COUNT], second[COUNT];
    int32_t indices[2 * COUNT];
    for (int i = 0; i < COUNT; ++i) {
        sizes[i] = 4.0f;
        angles[i] = -1.0f;
        best[i] = 1.0f;
        distances[i] = 100.0 * (double)ratio[i];
        second[i] = 100.0;
        indices[2 * i] = indices[2 * i + 1] = COUNT - 1 - i; /* the other way round */
    }
    check(mgca_pair_create(&pair) == MGCA_DONE, "a pair");
    check(mgca_pair_set_keypoints(pair, 1, points1, sizes, angles, COUNT) == MGCA_DONE, "keypoints 1");
    check(mgca_pair_set_keypoints(pair, 2, points2, NULL, NULL, COUNT) == MGCA_DONE, "keypoints 2");
    check(mgca_pair_set_camera(pair, 1, K, NULL, 0, 640.0, 480.0) == MGCA_DONE, "camera 1");
    check(mgca_filter_run(filter, pair, &result) == MGCA_DONE, "row i matches row i");
    check(mgca_result_ok(result) && mgca_result_mask(result)[0] == 1, "the pair is found");
    mgca_result_free(result);
    check(mgca_pair_set_matches(pair, indices, distances, second, COUNT) == MGCA_DONE, "matches");
    check(mgca_pair_set_attribute(pair, "ratio", ratio, COUNT) == MGCA_DONE, "ratio");
    check(mgca_pair_set_attribute(pair, "best", best, COUNT) == MGCA_DONE, "best");
    check(mgca_filter_run(filter, pair, &result) == MGCA_DONE, "run");
    check(mgca_result_ok(result) && mgca_result_mask(result)[COUNT - 1] == 1, "the order is that of the matches");
    const int plain = num_kept(result);
    mgca_result_free(result);

    const double bent[5] = {-0.3, 0.1, 0.0, 0.0, 0.0}, k[4] = {0.0, 0.0, 0.0, 0.0};
    check(mgca_pair_set_camera(pair, 1, K, bent, 5, 640.0, 480.0) == MGCA_DONE, "distortion");
    check(mgca_filter_run(filter, pair, &result) == MGCA_DONE, "run");
    check(num_kept(result) != plain, "distortion is felt");
    mgca_result_free(result);
    check(mgca_pair_set_fisheye(pair, 2, k) == MGCA_DONE, "fisheye");
    check(mgca_pair_set_resolution(pair, 2.0) == MGCA_DONE, "resolution");
    check(mgca_filter_run(filter, pair, &result) == MGCA_DONE, "run");
    mgca_result_free(result);
    fails(mgca_pair_set_resolution(pair, 0.0) || mgca_filter_run(filter, pair, &result), MGCA_ARGUMENT_ERROR,
          "resolution");
    check(result == NULL, "no result where a call failed");
    mgca_pair_set_resolution(pair, 1.0);
    indices[0] = COUNT;
    mgca_pair_set_matches(pair, indices, NULL, NULL, COUNT);
    fails(mgca_filter_run(filter, pair, &result), MGCA_ARGUMENT_ERROR, "matches[0]: index out of range");
    fails(mgca_pair_set_keypoints(pair, 3, points1, NULL, NULL, COUNT), MGCA_ARGUMENT_ERROR, "image: expected 1 or 2");
    fails(mgca_pair_set_keypoints(pair, 1, NULL, NULL, NULL, COUNT), MGCA_ARGUMENT_ERROR, "points: must not be NULL");
    fails(mgca_pair_set_camera(pair, 1, K, NULL, 4, 0.0, 0.0), MGCA_ARGUMENT_ERROR, "distortion: must not be NULL");
    fails(mgca_pair_set_fisheye(pair, 1, NULL), MGCA_ARGUMENT_ERROR, "k: must not be NULL");
    fails(mgca_pair_set_attribute(pair, "colour", ratio, COUNT), MGCA_ARGUMENT_ERROR, "'colour'");
    fails(mgca_filter_run(filter, NULL, &result), MGCA_ARGUMENT_ERROR, "pair: must not be NULL");
    fails(mgca_filter_run(NULL, pair, &result), MGCA_ARGUMENT_ERROR, "filter: must not be NULL");
    fails(mgca_filter_run(filter, pair, NULL), MGCA_ARGUMENT_ERROR, "result: must not be NULL");
    mgca_pair_free(pair);

    check(mgca_pair_create(&pair) == MGCA_DONE, "another pair");
    mgca_pair_set_keypoints(pair, 1, points1, NULL, NULL, COUNT);
    fails(mgca_filter_run(filter, pair, &result), MGCA_ARGUMENT_ERROR, "unlike numbers of keypoints");
    mgca_pair_free(pair);
}

static void models_are_checked(const char *file, const char *quick) {
    mgca_model *model = NULL;
    fails(mgca_model_open("no such file.onnx", 1, NULL, &model), MGCA_MODEL_ERROR, "model file not found");
    check(model == NULL, "no model where a call failed");
    fails(mgca_model_open(file, -1, NULL, &model), MGCA_ARGUMENT_ERROR, "threads");
    fails(mgca_model_open(file, 1, NULL, NULL), MGCA_ARGUMENT_ERROR, "model: must not be NULL");
    fails(mgca_model_open_memory("hello", 5, 1, NULL, &model), MGCA_MODEL_ERROR, "model in memory");
    fails(mgca_model_open_memory(NULL, 0, 1, NULL, &model), MGCA_ARGUMENT_ERROR, "data");
    fails(mgca_filter_create(NULL, NULL), MGCA_ARGUMENT_ERROR, "must not be NULL");
#if MGCA_TEST_EMBEDDED
    check(mgca_model_open(NULL, 1, NULL, &model) == MGCA_DONE, "the embedded models");
    check((strstr(mgca_model_name(model), " + ") != NULL) == (MGCA_TEST_EMBEDDED == 2), "all of them");
#else
    fails(mgca_model_open(NULL, 1, NULL, &model), MGCA_MODEL_ERROR, "MGCA_EMBED_MODEL");
#endif
    mgca_model_close(model);
    mgca_model_close(NULL);
    check(mgca_model_open(file, 1, "NoSuchExecutionProvider", &model) == MGCA_DONE, "a provider gives way");
    check(strstr(mgca_model_note(model, 0), "has no NoSuchExecutionProvider") != NULL, "with a note");
    mgca_model_close(model);
    mgca_model *first_look = NULL, *both = NULL;
    check(mgca_model_open(file, 1, NULL, &model) == MGCA_DONE, "a model");
    check(mgca_model_open(quick, 1, NULL, &first_look) == MGCA_DONE, "a first look");
    check(mgca_model_with_first_look(model, first_look, &both) == MGCA_DONE, "both");
    check(strlen(mgca_model_sha256(both)) == 64 + 3 + 64, "two digests");
    check(strncmp(mgca_model_sha256(both), mgca_model_sha256(first_look), 64) == 0, "in the order of asking");
    mgca_model *three = NULL;
    fails(mgca_model_with_first_look(both, first_look, &three), MGCA_ARGUMENT_ERROR, "one file each");
    fails(mgca_model_with_first_look(NULL, first_look, &three), MGCA_ARGUMENT_ERROR, "model: must not be NULL");
    fails(mgca_model_with_first_look(model, NULL, &three), MGCA_ARGUMENT_ERROR, "first_look: must not be NULL");
    fails(mgca_model_with_first_look(model, first_look, NULL), MGCA_ARGUMENT_ERROR, "both: must not be NULL");
    check(three == NULL, "no model where a call failed");
    mgca_model_close(both);
    mgca_model_close(first_look);
    mgca_model_close(model);
    mgca_filter_free(NULL);
    mgca_pair_free(NULL);
    mgca_result_free(NULL);
    check(mgca_result_status(NULL) == -1 && mgca_result_size(NULL) == 0 && mgca_result_mask(NULL) == NULL, "NULL");
    check(strcmp(mgca_status_word(MGCA_SUSPICIOUS_INTRINSICS), "suspicious_intrinsics") == 0, "last status");
    check(strcmp(mgca_status_word(99), "") == 0, "no status");
    check(strlen(mgca_version()) >= 5, "version");
}

/* A model of two files, which are closed again. */
static mgca_model *open_both(const char *file, const char *quick) {
    mgca_model *model = NULL, *first_look = NULL, *both = NULL;
    check(mgca_model_open(file, 2, " CPUExecutionProvider ,", &model) == MGCA_DONE, "a model");
    check(mgca_model_open(quick, 2, NULL, &first_look) == MGCA_DONE, "a first look");
    check(mgca_model_with_first_look(model, first_look, &both) == MGCA_DONE, "both");
    mgca_model_close(model);
    mgca_model_close(first_look);
    return both;
}

int main(int argc, char **argv) {
    if (argc != 3) {
        fprintf(stderr, "usage: test_c_interface MODEL FIRST_LOOK\n");
        return 2;
    }
    make_pair();
    models_are_checked(argv[1], argv[2]);
    mgca_model *model = open_both(argv[1], argv[2]);
    mgca_filter *filter = NULL;
    if (model == NULL || mgca_filter_create(model, &filter) != MGCA_DONE) {
        return 1;
    }
    check(strlen(mgca_model_name(model)) > 0 && strlen(mgca_model_version(model)) > 0, "name and version");
    check(mgca_model_note(model, 0) == NULL, "no notes");
    options_are_felt(model);
    mgca_model_close(model); /* the filter goes on */
    finds_the_pose(filter);
    pairs_are_read(filter);
    mgca_filter_free(filter);
    printf("C interface: %s\n", failures == 0 ? "all checks hold" : "checks failed");
    return failures == 0 ? 0 : 1;
}

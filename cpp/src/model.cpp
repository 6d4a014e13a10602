// Models: one file, or two of which the quicker is asked first; mgca_filter/inference/__init__.py.

#include "model.hpp"

#include "embedded_model.hpp"
#include "sha256.hpp"

#include <string_view>
#include <utility>

namespace mgca {
namespace {

using detail::OpenNetwork;

void check(const RuntimeOptions& options) {
    if (options.threads < 0) {
        throw ArgumentError("threads: expected 0 or more, got " + std::to_string(options.threads));
    }
}

std::shared_ptr<const Model::State> state_of(std::vector<std::shared_ptr<const OpenNetwork>> networks) {
    auto state = std::make_shared<Model::State>();
    for (const auto& one : networks) {
        const std::string joint = &one == &networks.front() ? "" : " + ";
        state->name += joint + one->metadata.name;
        state->version += joint + one->metadata.version;
        state->sha256 += joint + one->sha256;
        const std::vector<std::string>& notes = one->network->notes();
        state->notes.insert(state->notes.end(), notes.begin(), notes.end());
    }
    state->networks = std::move(networks);
    return state;
}

std::shared_ptr<const Model::State> open_model(std::string_view content, const std::string& source,
                                               const std::filesystem::path& file, const RuntimeOptions& options) {
    check(options);
    auto one = std::make_shared<OpenNetwork>();
    one->metadata = detail::read_metadata(content, source);
    one->sha256 = detail::sha256(content);
    one->network = detail::open_network(content, source, file, options);
    return state_of({std::move(one)});
}

}  // namespace

Model Model::from_file(const std::filesystem::path& file, const RuntimeOptions& options) {
    return Model(open_model(detail::read_model_file(file), file.string(), file, options));
}

Model Model::from_memory(const void* data, std::size_t size, const RuntimeOptions& options) {
    if (data == nullptr) {
        throw ArgumentError("data: expected the bytes of a model file");
    }
    return Model(open_model({static_cast<const char*>(data), size}, "model in memory", {}, options));
}

Model Model::with_first_look(const Model& quick) const {
    for (const Model* model : {this, &quick}) {
        if (model->state_->networks.size() > 1) {
            throw ArgumentError("first look: expected models of one file each, got " + model->name());
        }
    }
    return Model(state_of({quick.state_->networks[0], state_->networks[0]}));
}

bool has_embedded_model() noexcept { return !detail::embedded_model().empty(); }

Model embedded_model(const RuntimeOptions& options) {
    if (!has_embedded_model()) {
        throw ModelError("this library was built without a model in it (MGCA_EMBED_MODEL=ON); use Model::from_file");
    }
    const Model deep(open_model(detail::embedded_model(), "embedded model", {}, options));
    if (detail::embedded_first_look().empty()) {
        return deep;
    }
    return deep.with_first_look(Model(open_model(detail::embedded_first_look(), "embedded first look", {}, options)));
}

const std::string& Model::name() const noexcept { return state_->name; }

const std::string& Model::version() const noexcept { return state_->version; }

const std::string& Model::sha256() const noexcept { return state_->sha256; }

const std::vector<std::string>& Model::notes() const noexcept { return state_->notes; }

std::string Model::runtime() { return detail::runtime_name(); }

}  // namespace mgca

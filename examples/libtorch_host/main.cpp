// C++ host of a friction model: load the artefact, verify it with its test vectors, run it.
//
//   libtorch_host model.pt [calls [microseconds.txt]]
//
// The last file receives the time of every call.
// Exit status: 0 if the artefact passes its tests, 1 if not, 2 if it cannot be read.

#include <ATen/Parallel.h>
#include <torch/script.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <string>
#include <vector>

#include "json.hpp"

using torch::Tensor;
using Values = std::vector<torch::jit::IValue>;

static Tensor tensor_of(const Json &json) {
    std::vector<int64_t> shape;
    for (const Json *inner = &json; inner->kind == Json::List; inner = &inner->list.at(0))
        shape.push_back(static_cast<int64_t>(inner->list.size()));
    std::vector<double> flat;
    const auto walk = [&flat](const auto &self, const Json &node) -> void {
        if (node.kind == Json::List)
            for (const Json &inner : node.list) self(self, inner);
        else
            flat.push_back(node.value());
    };
    walk(walk, json);
    return torch::tensor(flat, torch::kFloat64).reshape(shape);
}

// The module's inputs in order, each (vector, joint).
static std::vector<Tensor> inputs_of(const Json &metadata) {
    std::vector<Tensor> inputs;
    for (const Json &name : metadata["inputs"].list)
        inputs.push_back(tensor_of(metadata["vectors"]["inputs"][name.text]));
    return inputs;
}

// Torque, coefficients and status for every vector; with a state, one after another.
static std::vector<Tensor> run(torch::jit::Module &module, const std::vector<Tensor> &inputs,
                               bool has_state) {
    const auto step = module.get_method("step");
    if (!has_state) {
        const auto found = step(Values(inputs.begin(), inputs.end())).toTuple()->elements();
        return {found[0].toTensor(), found[1].toTensor(), found[2].toTensor()};
    }
    Values first;
    for (std::size_t i = 0; i + 1 < inputs.size(); ++i) first.push_back(inputs[i][0]);
    auto state = module.get_method("initial_state")(first);
    std::vector<std::vector<Tensor>> columns(3);
    for (int64_t row = 0; row < inputs[0].size(0); ++row) {
        Values given;
        for (const Tensor &input : inputs) given.push_back(input[row]);
        given.push_back(state);
        const auto found = step(given).toTuple()->elements();
        for (std::size_t i = 0; i < 3; ++i) columns[i].push_back(found[i].toTensor());
        state = found[3];
    }
    return {torch::stack(columns[0]), torch::stack(columns[1]), torch::stack(columns[2])};
}

static double error_of(const Tensor &found, const Tensor &expected) {
    const auto scale = torch::nan_to_num(expected).abs().amax(0).clamp_min(1e-300);
    return (torch::nan_to_num(found - expected).abs().amax(0) / scale).max().item<double>();
}

static bool verify(torch::jit::Module &module, const Json &metadata) {
    const auto inputs = inputs_of(metadata);
    const auto found = run(module, inputs, metadata["state_size"].value() > 0);
    const Json &outputs = metadata["vectors"]["outputs"];
    const Tensor tau_f = tensor_of(outputs["tau_f"]), status = tensor_of(outputs["status"]);
    const double error = error_of(found[0], tau_f), tolerance = metadata["tolerance"].value();
    const auto edges = (found[2] != status).sum().item<int64_t>() +
                       (found[0].isnan() != tau_f.isnan()).sum().item<int64_t>();
    std::printf("%lld vectors: torque differs by %.1e of full scale (tolerance %.0e), %lld wrong "
                "at the edges\n",
                static_cast<long long>(tau_f.size(0)), error, tolerance,
                static_cast<long long>(edges));
    return error <= tolerance && edges == 0;
}

// One call of a control loop: one sample of every joint; only the torque, or a step with a state.
static std::vector<double> time_calls(torch::jit::Module &module, const Json &metadata, int calls) {
    const auto joints = static_cast<int64_t>(metadata["joints"].value());
    const bool has_state = metadata["state_size"].value() > 0;
    const auto full = [joints](double value) {
        return torch::full({joints}, value, torch::kFloat64);
    };
    Values sample{full(1.0), full(-5.0), full(1.0)};
    if (metadata["inputs"].list.size() == 2) sample.erase(sample.begin());  // position and load
    if (has_state)
        sample.push_back(module.get_method("initial_state")({sample.begin(), sample.end() - 1}));
    double *qd = sample[0].toTensor().data_ptr<double>();
    std::vector<double> microseconds;
    for (int call = -1000; call < calls; ++call) {  // the first thousand warm up
        std::fill(qd, qd + joints, std::sin(0.01 * call));
        const auto start = std::chrono::steady_clock::now();
        double tau_f;
        if (has_state) {
            const auto found = module.get_method("step")(sample).toTuple()->elements();
            tau_f = found[0].toTensor().data_ptr<double>()[0];
            sample.back() = found[3];
        } else {
            tau_f = module.forward(sample).toTensor().data_ptr<double>()[0];
        }
        const auto stop = std::chrono::steady_clock::now();
        if (std::isnan(tau_f)) throw std::runtime_error("a sound sample gives no torque");
        if (call >= 0)
            microseconds.push_back(std::chrono::duration<double, std::micro>(stop - start).count());
    }
    return microseconds;
}

static void report(std::vector<double> microseconds) {
    std::sort(microseconds.begin(), microseconds.end());
    const auto at = [&](double share) {
        return microseconds[static_cast<std::size_t>(share * double(microseconds.size() - 1))];
    };
    std::printf("latency over %zu calls: p50 %.2f us, p99 %.2f us\n", microseconds.size(), at(0.5),
                at(0.99));
}

int main(int argc, char **argv) {
    if (argc < 2) {
        std::fprintf(stderr, "usage: %s model.pt [calls [microseconds.txt]]\n", argv[0]);
        return 2;
    }
    try {
        // A control loop needs no gradients, no threads and no compilation at its second call.
        const c10::InferenceMode inference;
        at::set_num_threads(1);
        torch::jit::setGraphExecutorOptimize(false);

        torch::jit::ExtraFilesMap files{{"nfriction.json", ""}};
        auto module = torch::jit::load(argv[1], torch::kCPU, files);
        const Json metadata = JsonReader(files["nfriction.json"]).read();
        std::printf("%s of %lld joints\n", metadata["model"].text.c_str(),
                    static_cast<long long>(metadata["joints"].value()));
        if (!verify(module, metadata)) return 1;
        const int calls = argc > 2 ? std::max(1, std::atoi(argv[2])) : 20000;
        const auto microseconds = time_calls(module, metadata, calls);
        report(microseconds);
        if (argc > 3) {
            std::ofstream file(argv[3]);
            for (const double value : microseconds) file << value << '\n';
            if (!file.flush()) throw std::runtime_error("the times cannot be written");
        }
        return 0;
    } catch (const std::exception &error) {
        std::fprintf(stderr, "%s: %s\n", argv[1], error.what());
        return 2;
    }
}

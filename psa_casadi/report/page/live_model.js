// A model of psa_casadi in WebAssembly: parameters and a record in, a trajectory out. SI units.
var psaLive = {};

// Arrays lie in a page as base64 of little-endian numbers.
psaLive.doubles = function (base64) { return new Float64Array(psaPacked.bytes(base64).buffer); };
psaLive.singles = function (base64) { return Float64Array.from(new Float32Array(psaPacked.bytes(base64).buffer)); };

// Tolerance while a slider moves: the loosest that exact steps gain from, a thousandth of what a curve's width shows.
psaLive.dragged = 1e-5;

psaLive.reasons = {
  1: 'the step size became too small', 2: 'a value is not finite', 3: 'too many steps were needed',
  10: 'there is no equilibrium to start from', 11: 'the browser gives no more memory'
};

// Promise of a model. `data` lists inputs, outputs, states, parameters, as live_data.py writes them.
psaLive.load = function (data) {
  'use strict';
  function run(page, asked) {
    var n = asked.t.length, nu = data.inputs.length;
    function view(at, count) { return new Float64Array(page.memory.buffer, at, count); }
    if (page.page_reserve(n)) { return {status: 11, reason: psaLive.reasons[11]}; }
    view(page.page_parameters(), data.parameters.length).set(asked.values);
    view(page.page_nominal(), data.states.length).set(asked.nominals || data.nominals);
    view(page.page_error_size(), data.states.length).set(asked.error_sizes || data.error_sizes);
    view(page.page_deviation(), data.states.length).set(data.states.map(function (s) {
      return (asked.deviation && asked.deviation[s.name]) || 0;
    }));
    view(page.page_start(), data.states.length).set(asked.start || data.states.map(function (s) { return s.start; }));
    view(page.page_times(), n).set(asked.t);
    var inputs = view(page.page_inputs(), n * nu);
    data.inputs.forEach(function (input, j) {
      var given = asked.inputs[input.name];
      for (var k = 0; k < n; k += 1) { inputs[k * nu + j] = given ? given[k] : input.start; }
    });
    var settle = !asked.start && (asked.settle || !data.starts_itself);
    var status = page.page_run(asked.rtol || (asked.quick ? psaLive.dragged : 1e-6), asked.hold === 'zero' ? 1 : 0, settle ? (asked.rest ? 2 : 1) : 0,
      asked.quick ? 1 : 0, data.shown_nominal);
    function columns(at, names) {
      var all = view(at, n * names.length), found = {};
      names.forEach(function (row, i) {
        var column = new Float64Array(n);
        for (var k = 0; k < n; k += 1) { column[k] = all[k * names.length + i]; }
        found[row.name] = column;
      });
      return found;
    }
    if (status) { return {status: status, reason: psaLive.reasons[status]}; }
    return {
      status: 0, way: page.page_way() ? 'exact steps' : 'stepper', steps: page.page_steps(),
      outputs: columns(page.page_outputs(), data.outputs), states: columns(page.page_states(), data.states)
    };
  }
  return psaPacked.open(data.wasm).then(function (bytes) {
    try {
      return new WebAssembly.Instance(new WebAssembly.Module(bytes), {Math: Math});
    } catch (refused) { // browsers of before 2023 compile so much only beside the page's own work
      return WebAssembly.instantiate(bytes, {Math: Math}).then(function (made) { return made.instance; });
    }
  }).then(function (instance) { return function (asked) { return run(instance.exports, asked); }; });
};

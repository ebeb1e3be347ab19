// A model's FMU (FMI 3.0) out of a page: its C sources with the values chosen here as start values. No binaries.
psaLive.fmu = function (data, values, stack) {
  'use strict';
  var parts = data.fmu, name = stack.name.replace(/\W/g, '_').replace(/^(?=\d)/, '_');
  var starts = Object.create(null), sizes = Object.assign(Object.create(null), stack.fmu.sizes);
  data.parameters.forEach(function (p, i) {
    starts[p.name] = number(values[i]);
    if (values[i] !== 0) { sizes[p.name] = Math.abs(values[i]); }
  });

  // A number as C and XML read it: the shortest text of the same double, never an integer.
  function number(x) { return /[.e]/.test(String(x)) ? String(x) : x + '.0'; }
  function escaped(text) {
    return text.replace(/[&<>"]/g, function (c) { return {'&': '&amp;', '<': '&lt;', '>': '&gt;', '"': '&quot;'}[c]; });
  }
  function put(text, key, value) { return text.replace(new RegExp(' ' + key + '="[^"]*"'), function () { return ' ' + key + '="' + value + '"'; }); }
  function vector(text, key, row) {
    return text.replace(new RegExp('(' + key + '\\[[^\\]]*\\] = \\{).*'), function (_, head) {
      return head + row.concat(0).map(number).join(', ') + '};';
    });
  }

  var edit = {
    'modelDescription.xml': function (text) {
      var about = stack.fmu.description + ' Its values were chosen in a page.', span = stack.fmu.span;
      return put(text, 'description', escaped(about)).replace(/<DefaultExperiment [^>]*/, function (tag) {
        return put(put(tag, 'stopTime', number(span)), 'stepSize', number(span / 1000));
      }).replace(/<Float64 name="([^"]*)"[^>]*/g, function (tag, variable) {
        if (variable in sizes) { tag = put(tag, 'nominal', number(sizes[variable])); }
        return variable in starts ? put(tag, 'start', starts[variable]) : tag;
      });
    },
    'sources/fmi_data.c': function (text) {
      var states = data.states.map(function (s) { return stack.fmu.sizes[s.name] || 1; });
      text = vector(text, 'psa_start_parameters', values);
      return vector(vector(text, 'psa_state_nominals', states), 'psa_switch_scales', stack.fmu.scales);
    }
  };

  // The token belongs to sources and values: another value gives another (FNV-1a of 128 bits as a UUID).
  function token(texts) {
    var hash = BigInt('0x6c62272e07bb014262b821756295c58d'), prime = BigInt('0x1000000000000000000013b');
    new TextEncoder().encode(texts.join('')).forEach(function (byte) {
      hash = BigInt.asUintN(128, (hash ^ BigInt(byte)) * prime);
    });
    return '{' + hash.toString(16).padStart(32, '0').replace(/^(.{8})(.{4})(.{4})(.{4})/, '$1-$2-$3-$4-') + '}';
  }

  // Promise of the archive's bytes.
  return psaPacked.open(parts.packed).then(function (bytes) {
    var at = 0, edited = [];
    var files = parts.files.map(function (row) {
      var file = {name: row[0], bytes: bytes.subarray(at, at += row[1])};
      if (row[2]) {
        file.text = new TextDecoder().decode(file.bytes).split(parts.name).join(name);
        if (edit[file.name]) { file.text = edit[file.name](file.text); edited.push(file.text); }
      }
      return file;
    });
    var own = token(edited);
    return psaLive.zip(files.map(function (file) {
      return {name: file.name, bytes: file.text === undefined ? file.bytes
        : new TextEncoder().encode(file.text.split(parts.token).join(own))};
    }));
  });
};

// A ZIP archive of files that are stored, with fixed dates (APPNOTE 6.3.10, sections 4.3.7, 4.3.12 and 4.3.16).
psaLive.zip = function (files) {
  'use strict';
  var table = new Int32Array(256), parts = [], listed = [], at = 0, size = 0;
  for (var n = 0; n < 256; n += 1) {
    table[n] = n;
    for (var k = 0; k < 8; k += 1) { table[n] = table[n] & 1 ? 0xedb88320 ^ (table[n] >>> 1) : table[n] >>> 1; }
  }
  function crc(bytes) {
    var found = -1;
    for (var i = 0; i < bytes.length; i += 1) { found = table[(found ^ bytes[i]) & 255] ^ (found >>> 8); }
    return ~found >>> 0;
  }
  function little(fields) { // [bytes, value], ...
    var row = [];
    fields.forEach(function (f) { for (var i = 0; i < f[0]; i += 1) { row.push(f[1] / Math.pow(256, i) & 255); } });
    return Uint8Array.from(row);
  }
  var MODE = 0x81a40000, FIRST_DAY = 33; // a plain file, rw-r--r--; 1 January 1980
  files.forEach(function (file) {
    var title = new TextEncoder().encode(file.name), length = file.bytes.length;
    var common = [[2, 20], [2, 0], [2, 0], [2, 0], [2, FIRST_DAY], [4, crc(file.bytes)], [4, length], [4, length], [2, title.length], [2, 0]];
    parts.push(little([[4, 0x04034b50]].concat(common)), title, file.bytes);
    listed.push(little([[4, 0x02014b50], [2, 0x0314]].concat(common, [[2, 0], [2, 0], [2, 0], [4, MODE], [4, at]])), title);
    at += 30 + title.length + length;
  });
  listed.forEach(function (part) { size += part.length; });
  var end = little([[4, 0x06054b50], [2, 0], [2, 0], [2, files.length], [2, files.length], [4, size], [4, at], [2, 0]]);
  var all = new Uint8Array(at + size + end.length), place = 0;
  parts.concat(listed, [end]).forEach(function (part) { all.set(part, place); place += part.length; });
  return all;
};

// What a page holds packed: base64 of gzip, which browsers since 2023 undo by themselves.
var psaPacked = {};

psaPacked.bytes = function (base64) {
  'use strict';
  var text = atob(base64), found = new Uint8Array(text.length);
  for (var i = 0; i < text.length; i += 1) { found[i] = text.charCodeAt(i); }
  return found;
};

psaPacked.able = typeof DecompressionStream !== 'undefined';

// Promise of the bytes.
psaPacked.open = function (base64) {
  'use strict';
  if (!psaPacked.able) { return Promise.reject(new Error('it is older than 2023')); }
  var stream = new DecompressionStream('gzip'), writer = stream.writable.getWriter(), reader = stream.readable.getReader();
  var parts = [], size = 0;
  writer.write(psaPacked.bytes(base64));
  writer.close();
  function next(part) {
    if (!part.done) {
      parts.push(part.value);
      size += part.value.length;
      return reader.read().then(next);
    }
    var found = new Uint8Array(size), at = 0;
    parts.forEach(function (p) { found.set(p, at); at += p.length; });
    return found;
  }
  return reader.read().then(next);
};

psaPacked.text = function (base64) {
  'use strict';
  return psaPacked.open(base64).then(function (bytes) { return new TextDecoder().decode(bytes); });
};

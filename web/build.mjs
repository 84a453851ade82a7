// Bundles the viewer with Spark and three.js into one script, with their licences on top.
import { readFileSync } from 'node:fs';
import { build } from 'esbuild';

const OUT = '../src/splatax/web/viewer.js';
const LIBRARIES = ['three', '@sparkjsdev/spark', 'fflate'];

const licences = LIBRARIES.map((name) => {
  const folder = `node_modules/${name}`;
  const { version } = JSON.parse(readFileSync(`${folder}/package.json`, 'utf8'));
  return `${name} ${version}\n\n${readFileSync(`${folder}/LICENSE`, 'utf8').trim()}`;
});

await build({
  entryPoints: ['src/main.js'],
  outfile: OUT,
  bundle: true,
  minify: true,
  format: 'iife',
  target: 'es2022',
  legalComments: 'none',
  logLevel: 'warning',
  banner: { js: `/* Contains\n\n${licences.join('\n\n----\n\n').replaceAll('*/', '* /')}\n*/` },
});

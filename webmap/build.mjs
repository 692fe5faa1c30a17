// Bundle the map page and the window around it (index.html, app.js, app.css and shell.*, which refer to no other host).
// `node build.mjs [folder]`; the default folder is src/apertura/views/webmap/page.
import { build } from 'esbuild';
import { copyFile, mkdir, rename, rm } from 'node:fs/promises';
import { dirname, join, resolve } from 'node:path';
import { fileURLToPath } from 'node:url';

const here = dirname(fileURLToPath(import.meta.url));
const folder = resolve(process.argv[2] ?? join(here, '../src/apertura/views/webmap/page'));
const beside = `${folder}.wip`;

await rm(beside, { recursive: true, force: true });
await mkdir(beside, { recursive: true });
await build({
  entryPoints: [join(here, 'src/app.js'), join(here, 'src/shell.js')],
  outdir: beside,
  absWorkingDir: here,
  bundle: true,
  minify: true,
  format: 'iife',
  target: 'es2022',
  charset: 'utf8',
  legalComments: 'inline', // include the licences of the bundled packages
  logLevel: 'warning',
});
for (const page of ['index.html', 'shell.html']) await copyFile(join(here, 'src', page), join(beside, page));
await rm(folder, { recursive: true, force: true });
await rename(beside, folder);
